"""Every kind of file we write, judged by programs that we did not write: no findings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recordings.recover import recover_recording
from recordings.schema.messages import CaptureEvent, Stamps
from recordings.schema.viewing import DETECTED, Marks
from recordings.writer import RecordingWriter
from tests.foreign.judges import JUDGES, rerun
from tests.recordings.small_recording import START_NS, TURNED, make_info, make_picture, make_state, make_view

SAMPLE = Path(__file__).parents[2] / "recordings" / "samples" / "paper-640.mcap"
POSES, STATES_A_POSE = 8, 120


def fresh(folder: Path) -> Path:
    """Like a session: states at 500 Hz, flushed while they come; a view's time lies before its writing."""
    with RecordingWriter(folder / "fresh.mcap", make_info()) as writer:
        writer.attach("plan.yaml", "application/yaml", b"poses: 8\n")
        for index in range(POSES):
            for count in range(index * STATES_A_POSE, (index + 1) * STATES_A_POSE):
                writer.robot_state(make_state(count))
                if count % 50 == 49:
                    writer.flush()
            now_ns = (index + 1) * STATES_A_POSE * 2_000_000
            stamps = Stamps(now_ns, START_NS + now_ns, device_ns=now_ns)
            writer.image(_at(make_picture(index), stamps))
            writer.marks(index, [Marks(np.zeros((2, 2)), DETECTED, np.ones((2, 2)))], "0.1 px")
            writer.view(_at(make_view(index), Stamps(now_ns, START_NS + now_ns - 5_000_000)))
            writer.event(CaptureEvent(stamps, "captured", pose_index=index))
        writer.frame("flange", "camera", TURNED)
        return writer.finish()


def _at(message, stamps):
    from msgspec.structs import replace

    return replace(message, stamps=stamps)


def recovered(folder: Path) -> Path:
    path = fresh(folder)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data[:-3000])
    return recover_recording(path, folder / "saved.mcap")[0].path


FILES = {"fresh": fresh, "sample": lambda folder: SAMPLE, "recovered": recovered}


@pytest.mark.parametrize("judge", JUDGES)
@pytest.mark.parametrize("kind", FILES)
def test_nobody_finds_anything(tmp_path: Path, kind: str, judge: str) -> None:
    assert JUDGES[judge](FILES[kind](tmp_path)) == []


@pytest.mark.parametrize("judge", JUDGES)
def test_a_judge_sees_what_is_wrong(tmp_path: Path, judge: str) -> None:
    """One that is always content would be none."""
    path = fresh(tmp_path)
    path.write_bytes(path.read_bytes()[:-3000])
    assert JUDGES[judge](path)


def test_rerun_draws_pictures_frames_and_events_without_a_plugin(tmp_path: Path) -> None:
    rerun("mcap", "convert", str(fresh(tmp_path)), "-o", str(tmp_path / "a.rrd"))
    shown = rerun("rrd", "print", str(tmp_path / "a.rrd"))
    for column in ("Image:buffer", "Pinhole:image_from_camera", "Transform3D:translation", "TextLog:text"):
        assert column in shown, f"rerun shows no {column}"
    assert "station.RobotState" in shown
