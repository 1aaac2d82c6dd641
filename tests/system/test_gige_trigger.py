"""A whole session whose pictures come over GigE Vision, each fired by the trigger box on its serial line."""

from __future__ import annotations

from pathlib import Path

import pytest

from recordings.reader import open_recording
from station.cli.attended import attended
from station.cli.demo import simulated_daemon
from station.devices.frames import frames_between
from station.protocol.verbs import LoadPlan, Purpose
from station.simulation.cells import cell_config, make_cell
from tests.station.quick_plan import quick_plan

POSES = 3


@pytest.mark.gige
@pytest.mark.process
async def test_every_pose_has_the_picture_of_its_own_pulse(lonely_network: None, tmp_path: Path) -> None:
    truth = make_cell()
    plan = quick_plan(cell_config(truth), truth, seed=0, count=POSES)
    with simulated_daemon(tmp_path, ["--gige", "--hardware-trigger"]) as socket:
        async with attended(socket, headless=True, quiet=True) as shell:
            await shell.client.call(LoadPlan(plan))
            ended = await shell.carry_out(Purpose.RUN)
    assert ended.session.captured == POSES, ended.reason
    box = ended.trigger
    assert box.identity == "calibration-trigger SIM1" and box.pulses == box.frames > POSES, "glimpses too"
    pictures = [picture for _, picture in open_recording(Path(ended.session.recording)).images()]
    ids, counts = [p.frame_id for p in pictures], [p.trigger_count or 0 for p in pictures]
    assert counts[0] > 0 and counts == sorted(set(counts))
    # One frame for one pulse, glimpses included: ids and counts go on together.
    assert [frames_between(ids[0], i) for i in ids] == [count - counts[0] for count in counts]
