"""The real daemon, driver and controller: stop, lost operators, and every way a daemon can end."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import msgspec
import pytest

from recordings.reader import open_recording
from recordings.recover import recover_recording
from station.cell.pose_plan import Plan
from station.cell.status import StationState as S
from station.simulation.truth import write_truth
from tests.patience import PATIENCE_S, until
from tests.system.conftest import TRUTH, SystemRig, both_paths, go, status_when

pytestmark = pytest.mark.process


async def test_a_killed_operator_stops_the_arm_and_stop_from_a_watcher_is_latched(
    rig: SystemRig, short_plan: Plan
) -> None:
    daemon = await rig.daemon()
    anna = await daemon.client()
    async with await daemon.client() as bert:
        await go(anna, short_plan)
        await rig.moving()
        anna._writer.transport.abort()  # what the kernel does to a killed screen
        await rig.stops()
        status = await status_when(bert, lambda s: s.state is S.PAUSED)
        assert (status.cause, status.lease.holder) == ("control-lost", "")
        await rig.stays_at_rest()
        async with await daemon.client() as cleo:
            await go(cleo, None, "resume")
            await rig.moving()
            await bert.request("stop")
            await rig.stops()
            status = await status_when(cleo, lambda s: s.state is S.STOPPED)
            assert status.cause == "stop"
            await rig.stays_at_rest()
            await cleo.request("acknowledge")
            await go(cleo, None, "resume")
            done = await status_when(cleo, lambda s: bool(s.session.recording))
        assert len(open_recording(Path(done.session.recording)).views()) == len(short_plan.poses)
    await anna.close()


async def test_another_cells_daemon_on_the_same_folder_leaves_a_killed_ones_session_alone(
    rig: SystemRig, short_plan: Plan
) -> None:
    first = await rig.daemon()
    async with await first.client() as anna:
        await go(anna, short_plan)
        begun = await status_when(anna, lambda s: s.session.captured >= 1)
        first.process.kill()
        await rig.rests()
    other_camera = msgspec.structs.replace(TRUTH, seed=6)  # its serial number follows the seed
    write_truth(other_camera, rig.folder / "truth.json")
    second = await rig.daemon()
    async with await second.client() as bert:
        status = await status_when(bert, lambda s: s.state is S.IDLE and s.camera.connected)
        [told] = [event for event in status.events if event.code == "interrupted-elsewhere"]
        assert told.values["what"] == "camera"
        assert {told.values["first"], told.values["now"]} == {
            f"MER-131-75GM SIM0000{seed}" for seed in (5, 6)
        }
        await go(bert, short_plan)
        done = await status_when(bert, lambda s: bool(s.session.recording))
    assert done.session.folder != begun.session.folder
    recover_recording(Path(begun.session.folder))
    for folder, seed in ((begun.session.folder, 5), (done.session.folder, 6)):
        [segment] = open_recording(Path(folder)).segments
        assert segment.info.camera_identity.serial == f"SIM0000{seed}"


def children_of(pid: int) -> list[Path]:
    """Their folders in /proc, which vanish with them."""
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [Path("/proc") / child for child in listed]


@both_paths
async def test_a_daemon_that_hangs_is_killed_or_told_to_end_stops_the_arm(
    rig: SystemRig, short_plan: Plan
) -> None:
    first = await rig.daemon()
    async with await first.client() as anna:
        await go(anna, short_plan)
        await status_when(anna, lambda s: s.session.captured == 1)
        await rig.moving()
        heard = first.notified.heard()
        assert "READY=1" in heard and "WATCHDOG=1" in heard
        # It hangs: no word to systemd, and it waits for a person when it goes on.
        first.process.send_signal(signal.SIGSTOP)
        await rig.stops()
        first.notified.heard()
        await asyncio.sleep(1.2)
        assert "WATCHDOG=1" not in first.notified.heard()
        first.process.send_signal(signal.SIGCONT)
        status = await status_when(anna, lambda s: s.state in (S.FAULT, S.STOPPED))
        assert status.cause
        await rig.stays_at_rest()
        await anna.request("acknowledge")
        await go(anna, None, "resume")
        await rig.moving()
        children = children_of(first.process.pid)
        assert len(children) >= 2, "worker and control process"
        first.process.kill()
        await rig.stops()
        await until(lambda: not any(child.is_dir() for child in children))
    # The next one waits for a person, goes on with the same session, and seals it when it is told to end.
    second = await rig.daemon()
    async with await second.client() as anna:
        status = await status_when(anna, lambda s: s.state is S.STOPPED)
        captured = status.session.captured
        assert captured >= 1
        await rig.stays_at_rest()
        await status_when(anna, lambda s: s.robot.connected and s.camera.connected)
        await anna.request("acknowledge")
        await go(anna, None, "resume")
        await rig.moving()
        second.process.terminate()
        await rig.stops()
        await asyncio.to_thread(second.process.wait, PATIENCE_S)
    assert second.process.returncode == 0
    folder = Path(status.session.folder)
    assert not list(folder.glob("*.part"))
    assert len(open_recording(folder).views()) >= captured
    assert not second.socket.exists()


@pytest.mark.parametrize(("hangs", "exit_code"), [("camera", 0), ("disk", 1)])
async def test_a_daemon_told_to_end_ends_whatever_hangs(
    rig: SystemRig, short_plan: Plan, monkeypatch: pytest.MonkeyPatch, hangs: str, exit_code: int
) -> None:
    """The arm stands, what can be finished is finished, and no thread that hangs is waited for."""
    monkeypatch.setenv("CELL_HANGS", hangs)
    daemon = await rig.daemon()
    stuck = S.CAPTURING if hangs == "camera" else S.WRITING
    async with await daemon.client() as anna:
        await go(anna, short_plan)
        await status_when(anna, lambda s: s.state is stuck and s.session.captured == (hangs == "camera"))
        daemon.process.terminate()
        await asyncio.to_thread(daemon.process.wait, PATIENCE_S)
    assert daemon.process.returncode == exit_code
    await rig.stays_at_rest()
    (folder,) = (rig.root / "sessions").iterdir()
    if hangs == "camera":
        assert not list(folder.glob("*.part"))
        assert len(open_recording(folder).views()) == 1
