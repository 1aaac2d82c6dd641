"""How fast frames travel: simulated GigE camera → Aravis → recorder → disk, with 500 Hz robot states beside.

Files of ten seconds are each verified in a process of low priority (every picture to the bit, every frame
id and sequence) and deleted. Frames are 1280×1024 mono8 in packets of 8996 bytes over loopback.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np

from recordings.messages import CameraModel, Picture, RobotState, SessionInfo, Stamps
from recordings.reader import open_recording
from recordings.recorder import Recorder
from station.cli_serve import PRIORITY
from station.config import PAPER_BOARD, CameraConfig
from station.devices.aravis import AravisCamera
from station.devices.frames import frames_between
from station.simulation import genicam
from station.simulation.gige import numbered_picture
from station.simulation.gige_launch import SimulatedGige, start_gige
from station.simulation.netns import isolated_command

FILE_S = 10.0
STATE_HZ = 500.0
SHARE = float(os.environ.get("BENCH_SHARE", "1"))


@dataclass
class Outcome:
    fps: float
    seconds: float
    frames: int
    lost: int
    """Gaps in the frame ids"""
    dropped: int
    """By the recorder, pictures and states"""
    wrong: int
    """Recorded pictures that differ from what was sent, or are missing or out of order in the file"""
    verified: int
    states: int
    client_cores: float
    """CPU time of camera, recorder and states per second"""
    server_cores: float
    memory_mib: float


def run() -> str:
    rows = [measure(75.0, 60 * SHARE), measure(150.0, 120 * SHARE)]
    header = "asked fps|s|frames|fps|lost|dropped|verified|wrong|states|CPU client|CPU simulator|memory"
    lines = [f"| {header.replace('|', ' | ')} |", "|" + "---|" * 12]
    for asked, r in zip((75, 150), rows, strict=True):
        lines.append(
            f"| {asked} | {r.seconds:.0f} | {r.frames} | {r.fps:.1f} | {r.lost} | {r.dropped} | {r.verified} "
            f"| {r.wrong} | {r.states} | {r.client_cores:.2f} cores | {r.server_cores:.2f} cores "
            f"| {r.memory_mib:.0f} MiB |"
        )
    return "\n".join(lines)


def measure(fps: float, seconds: float) -> Outcome:
    """In a process of its own, in a network namespace with only `lo`. RuntimeError with its last words."""
    command = [sys.executable, "-m", "benchmarks.gige_throughput", str(fps), str(seconds)]
    done = subprocess.run(isolated_command(command), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(done.stderr[-2000:])
    return msgspec.json.decode(done.stdout.splitlines()[-1], type=Outcome)


class Rotation:
    """Recorders of ten seconds each; finished files are verified and deleted."""

    def __init__(self, folder: Path, frames_per_file: int) -> None:
        self._folder = folder
        self._frames_per_file = frames_per_file
        self._recorder: Recorder | None = None
        self._verifier = ProcessPoolExecutor(1, initializer=os.nice, initargs=(19,))
        self._sealed: list[tuple[Recorder, Future[Path]]] = []
        self._results: list[Future[tuple[int, int]]] = []
        self._lock = threading.Lock()
        self.states = 0

    def picture(self, picture: Picture) -> None:
        if picture.sequence % self._frames_per_file == 0:
            self._next(picture.sequence // self._frames_per_file)
        assert self._recorder is not None
        self._recorder.picture(picture)

    def state(self, state: RobotState) -> None:
        with self._lock:
            if self._recorder is not None:
                self.states += self._recorder.robot_state(state)

    def finish(self) -> tuple[int, int, int]:
        """Drops, pictures verified, and how many of them were wrong."""
        self._next(None)
        wait(finished for _, finished in self._sealed)
        while len(self._results) < len(self._sealed):
            time.sleep(0.01)  # callbacks come a moment after their future
        results = [result.result() for result in self._results]
        self._verifier.shutdown()
        return (
            sum(recorder.dropped for recorder, _ in self._sealed),
            sum(good for good, _ in results),
            sum(bad for _, bad in results),
        )

    def _next(self, number: int | None) -> None:
        with self._lock:
            before = self._recorder
            self._recorder = None if number is None else self._open(number)
        if before is not None:
            finished = before.finish()
            self._sealed.append((before, finished))
            finished.add_done_callback(self._verify)

    def _open(self, number: int) -> Recorder:
        path = self._folder / f"{number}.mcap"
        info = SessionInfo("bench", "eye-in-hand", "simulated", PAPER_BOARD, CameraModel(1280, 1024))
        return Recorder(path, info)

    def _verify(self, sealed: Future[Path]) -> None:
        self._results.append(self._verifier.submit(verify, sealed.result()))


def verify(path: Path) -> tuple[int, int]:
    """Pictures in the file and how many are not what the simulator sent; deletes the file."""
    part = open_recording(path).parts[0]
    sequences = part.picture_sequences()
    wrong = (sequences[-1] - sequences[0] + 1) - len(sequences)
    previous: tuple[int, int] | None = None
    for sequence in sequences:
        picture = part.picture(sequence)
        number = int.from_bytes(picture.image.reshape(-1)[:8].tobytes(), "little")
        same = np.array_equal(picture.image, numbered_picture(number, 1280, 1024))
        follows = previous is None or (
            frames_between(previous[0], picture.frame_id) == 1 and number == previous[1] + 1
        )
        wrong += not (same and follows)
        previous = picture.frame_id, number
    path.unlink()
    return len(sequences), wrong


def publish_states(callback: Callable[[RobotState], None], stop: threading.Event) -> None:
    """Robot states at 500 Hz, as a controller would send them."""
    zeros = (0.0,) * 6
    start_s = time.monotonic()
    count = 0
    while not stop.is_set():
        stamps = Stamps(time.monotonic_ns(), time.time_ns(), controller_s=count / STATE_HZ)
        callback(RobotState(stamps, zeros, zeros, zeros, zeros, 7, 1, 1, 2, 1, 1.0, 1.0))
        count += 1
        time.sleep(max(0.0, start_s + count / STATE_HZ - time.monotonic()))


async def stream(server: SimulatedGige, fps: float, seconds: float, folder: Path) -> Outcome:
    server.inject("register", [genicam.FRAME_PERIOD, round(1e6 / fps)])
    camera = AravisCamera(CameraConfig(device="127.0.0.1", trigger="free-running", packet_size=8996))
    await camera.open()
    rotation = Rotation(folder, round(FILE_S * fps))
    stop = threading.Event()
    states = threading.Thread(target=publish_states, args=(rotation.state, stop))
    states.start()
    before, server_before, start_s = cpu_s(), process_cpu_s(server.process.pid), time.monotonic()
    asyncio.get_running_loop().call_later(seconds, stop.set)
    await camera.stream(rotation.picture, stop)
    took_s = time.monotonic() - start_s
    client, served = cpu_s() - before, process_cpu_s(server.process.pid) - server_before
    states.join()
    memory_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    await camera.close()
    dropped, verified, wrong = await asyncio.to_thread(rotation.finish)
    return Outcome(
        fps=camera.counter.frames / took_s,
        seconds=took_s,
        frames=camera.counter.frames,
        lost=camera.counter.missing,
        dropped=dropped,
        wrong=wrong,
        verified=verified,
        states=rotation.states,
        client_cores=client / took_s,
        server_cores=served / took_s,
        memory_mib=memory_mib,
    )


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def process_cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    with contextlib.suppress(OSError):  # as `station serve` does, where it may
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    with tempfile.TemporaryDirectory() as folder, start_gige(numbered=True) as running:
        outcome = asyncio.run(stream(running, float(sys.argv[1]), float(sys.argv[2]), Path(folder)))
    print(json.dumps(asdict(outcome)))
