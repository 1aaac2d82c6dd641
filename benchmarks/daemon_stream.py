"""Frames that the daemon keeps: simulated GigE camera → `station serve` → disk, the arm in motion.

The real daemon, without a screen, in a network namespace with only `lo`: a simulated UR10e swings under a go
given over the control socket, a free-running camera sends 1280×1024 mono8 in packets of 8996 bytes. A minute
makes a session. Each sealed session is verified by a process of low priority (every picture to the bit,
numbers, frame ids, the controller's time stamps of all states) and deleted: from the third minute on while
the next ones are recorded, the last two afterwards.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.processes import DaemonUsage, put_before_others, step_behind_others
from recordings.reader import open_recording
from recordings.schema.frame_ids import frames_between
from recordings.segment import RecordingSegment
from station.cell.plan import Plan, PlannedPose
from station.cell.status import StationState, StationStatus
from station.cli.demo import approve_simulated
from station.cli.serve import log_to_stderr, serve_cell
from station.devices.aravis import AravisCamera
from station.devices.cell import Cell
from station.operate.motion import carry_out, wait_until_idle
from station.plan.files import sweep_plan
from station.protocol.client import Client
from station.protocol.verbs import Purpose
from station.simulation.cell import CellTruth
from station.simulation.launch import ChildProcess
from station.simulation.launch_cell import GIGE_PACKET_BYTES, SimulationOptions, simulated_cell
from station.simulation.netns import isolated_command
from tests.numbered_gige import numbered_picture, start_numbered, still_picture

SESSION_S = 60.0
STATE_PERIOD_S = 0.002
NICENESS = -19
"""Where that is permitted: what else this computer does is not the question."""
WAITING = 2
"""Sessions on the disk that wait for their verification"""
SHARE = float(os.environ.get("BENCH_SHARE", "1"))


@dataclass
class Checked:
    """Figures of one finished session, or the sum of several."""

    frames: int = 0
    """Sent by the camera between the first and the last one recorded, both included"""
    lost: int = 0
    """Number of them that are not in the file"""
    reordered: int = 0
    wrong: int = 0
    """Pictures that are not what was sent under their number, or whose frame id does not fit it"""
    seconds: float = 0.0
    """By the camera's clock"""
    states: int = 0
    states_lost: int = 0
    """By the controller's time stamps"""
    states_s: float = 0.0

    def __add__(self, other: Checked) -> Checked:
        return Checked(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass
class StreamOutcome:
    asked_fps: float
    sessions: int
    checked: Checked
    dropped: int
    """By the recorder, pictures and states"""
    station_cores: float
    """CPU time of daemon, control process and worker per second"""
    simulator_cores: float
    memory_mib: float
    """Largest of the daemon"""
    lag_ms: float
    """Latest round of the daemon's loop: at 100 ms the arm stops"""
    sync_ms: float
    load: float
    """Load of the whole machine, with all that runs on it besides"""

    @property
    def clean(self) -> bool:
        c = self.checked
        return not any((c.lost, c.reordered, c.wrong, c.states_lost, self.dropped))


HEADER = (
    "asked fps|sessions|s|frames sent|fps|lost|reordered|wrong|states|Hz|states lost|dropped by the recorder"
    "|CPU station|CPU simulators|memory|loop late|slowest sync|load"
)


def row(o: StreamOutcome) -> str:
    """Write the row of the table under `HEADER`."""
    c = o.checked
    cells = (
        f"{o.asked_fps:g}|{o.sessions}|{c.seconds:.0f}|{c.frames}|{c.frames / c.seconds:.1f}|{c.lost}"
        f"|{c.reordered}|{c.wrong}|{c.states}|{c.states / c.states_s:.0f}|{c.states_lost}|{o.dropped}"
        f"|{o.station_cores:.2f} cores|{o.simulator_cores:.2f} cores|{o.memory_mib:.0f} MiB"
        f"|{o.lag_ms:.0f} ms|{o.sync_ms:.0f} ms|{o.load:.1f}"
    )
    return f"| {cells.replace('|', ' | ')} |"


def run() -> str:
    rows = [row(measure(75.0, 60 * SHARE)), row(measure(75.0, 600 * SHARE)), row(measure(150.0, 120 * SHARE))]
    return "\n".join([f"| {HEADER.replace('|', ' | ')} |", "|" + "---|" * (HEADER.count("|") + 1), *rows])


def measure(fps: float, seconds: float) -> StreamOutcome:
    """In a network namespace of its own. RuntimeError with its last words."""
    command = [sys.executable, "-m", "benchmarks.daemon_stream", str(fps), str(seconds)]
    done = subprocess.run(isolated_command(command), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(done.stderr[-2000:])
    return msgspec.json.decode(done.stdout.splitlines()[-1], type=StreamOutcome)


def verify(path: Path) -> Checked:
    """Reads the recording strictly, compares everything, deletes it."""
    recording = open_recording(path)
    truth = msgspec.json.decode(recording.attachments()["truth.json"], type=CellTruth)
    checked = _pictures(recording.segments[0], still_picture(truth))
    times = np.array([s.stamps.controller_s for s in recording.robot_states()])
    steps = np.round(np.diff(times) / STATE_PERIOD_S).astype(int)
    checked.states, checked.states_s = len(times), float(np.ptp(times))
    checked.states_lost = int(np.abs(steps - 1).sum())
    path.unlink()
    return checked


def _pictures(part: RecordingSegment, still: np.ndarray) -> Checked:
    checked = Checked()
    last: tuple[int, int | None] | None = None
    first_ns = 0
    for sequence in part.image_sequences():
        picture = part.image(sequence)
        number = int.from_bytes(picture.pixels.reshape(-1)[:8].tobytes(), "little")
        height, width = picture.pixels.shape
        same = np.array_equal(picture.pixels, numbered_picture(number, width, height, still))
        if last is None:
            first_ns = picture.stamps.device_ns
        else:
            assert last[1] is not None and picture.frame_id is not None
            same &= frames_between(last[1], picture.frame_id) == number - last[0]
            checked.reordered += number <= last[0]
            checked.lost += max(0, number - last[0] - 1)
        checked.wrong += not same
        checked.frames += 1
        checked.seconds = (picture.stamps.device_ns - first_ns) / 1e9
        last = number, picture.frame_id
    checked.frames += checked.lost
    return checked


def long_sweep(status: StationStatus, seconds: float) -> Plan:
    """The sweep's swings over and over, for about so long."""
    assert status.robot.joints_rad is not None
    once = sweep_plan(status.robot.model, status.mount, status.robot.joints_rad)
    poses: list[PlannedPose] = []
    here, took_s = np.array(status.robot.joints_rad), 0.0
    while took_s < seconds:
        pose = once.poses[len(poses) % len(once.poses)]
        way_rad = float(np.abs(np.array(pose.joints_rad) - here).max())
        took_s += way_rad / once.joint_speed_rad_s + once.joint_speed_rad_s / once.joint_acceleration_rad_s2
        here = np.array(pose.joints_rad)
        poses.append(msgspec.structs.replace(pose, name=f"swing {len(poses) + 1}"))
    return msgspec.structs.replace(once, poses=tuple(poses))


async def stream(fps: float, seconds: float, root: Path) -> StreamOutcome:
    verifier = ProcessPoolExecutor(1, initializer=step_behind_others)
    verifier.submit(int).result()  # forked before there is much to share
    outcome = StreamOutcome(fps, 0, Checked(), 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    waiting: list[Path] = []
    verified: list[Future[Checked]] = []
    socket = root / "control.sock"
    command = [sys.executable, "-m", "benchmarks.daemon_stream", "serve", str(fps), str(root)]
    with (
        (root / "daemon.log").open("wb") as log,
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, start_new_session=True
        ) as started,
        ChildProcess(started) as child,
    ):
        assert child.process.stdout is not None
        child.process.stdout.readline()  # ready
        daemon = child.process.pid
        async with await Client.connect(socket) as client:
            idle = await wait_until_idle(client)
            await client.request("lease", action="take")
            await client.request(
                "load_plan", plan=msgspec.to_builtins(long_sweep(idle, min(seconds, SESSION_S)))
            )
            usage = DaemonUsage(daemon)

            def look(status: StationStatus) -> None:
                put_before_others(daemon, NICENESS)  # each go starts a control process
                usage.sample()
                outcome.dropped = max(outcome.dropped, status.recorder.drops)
                if status.state is StationState.MOVING:
                    outcome.lag_ms = max(outcome.lag_ms, status.loop_lag_ms)
                    outcome.sync_ms = max(outcome.sync_ms, status.recorder.sync_ms)

            for _ in range(max(1, round(seconds / SESSION_S))):
                ended = await carry_out(client, Purpose.RUN, approve_simulated, look)
                if not ended.session.recording or ended.session.captured < len(ended.session.poses):
                    raise RuntimeError(f"{ended.state.value}: {ended.reason}")
                outcome.sessions += 1
                waiting.append(Path(ended.session.recording))
                if len(waiting) > WAITING:
                    if verified:  # the disk has an end
                        await asyncio.wrap_future(verified[-1])
                    verified.append(verifier.submit(verify, waiting.pop(0)))
            outcome.station_cores = usage.cores(simulators=False)
            outcome.simulator_cores = usage.cores(simulators=True)
            outcome.memory_mib, outcome.load = usage.memory_mib(), os.getloadavg()[1]
    for done in (*verified, *(verifier.submit(verify, path) for path in waiting)):
        outcome.checked += await asyncio.wrap_future(done)
    verifier.shutdown()
    return outcome


def streaming_cell(fps: float, folder: Path) -> Cell:
    """Make a simulated cell whose GigE camera runs freely: numbered images over what the start shows."""
    cell = simulated_cell(SimulationOptions(robot="UR10e"), folder)
    simulator = start_numbered(folder / "truth.json", serial="SIM00000")
    camera = msgspec.structs.replace(
        cell.config.camera, driver="aravis", device="127.0.0.1", packet_size=GIGE_PACKET_BYTES,
        trigger="free-running", frame_rate_hz=fps,
        exposure_us=min(cell.config.camera.exposure_us, 0.5e6 / fps),
    )  # fmt: skip
    config = msgspec.structs.replace(cell.config, camera=camera)

    def ended() -> None:
        simulator.stop()
        cell.ended()

    return replace(cell, config=config, camera=AravisCamera(camera, None), ended=ended)


if __name__ == "__main__" and sys.argv[1] == "serve":
    log_to_stderr()
    place = Path(sys.argv[3])
    made = streaming_cell(float(sys.argv[2]), place / "simulation")
    asyncio.run(serve_cell(made, place, place / "control.sock", end_with_stdin=True))
elif __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(asdict(asyncio.run(stream(float(sys.argv[1]), float(sys.argv[2]), Path(folder))))))
