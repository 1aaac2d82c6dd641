"""How fast frames travel: simulated GigE camera → Aravis → recorder → disk, with 500 Hz robot states beside.

The camera counts what it sent: frames it did not get to send are its own, every other one that is missing is
lost. Files of ten seconds are each verified in a process of low priority (every picture to the bit, frame
ids, numbers, count of robot states) and deleted. Frames are 1280×1024 mono8 in packets of 8996 bytes.
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
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
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
LAST_FRAMES_S = 1.0
"""Frames that are still on their way when the camera stops."""


@dataclass
class Outcome:
    asked_fps: float
    seconds: float
    sent: int
    """Frames, from the first one received on"""
    lost: int
    """Sent, but not received whole"""
    reordered: int
    dropped: int
    """By the recorder, pictures and states"""
    verified: int
    """Pictures in the files"""
    wrong: int
    """Of them: other than what was sent under that number, or out of place"""
    states: int
    """Sent; each is in a file"""
    states_lost: int
    station_cores: float
    """CPU time of camera, recorder and states per second"""
    simulator_cores: float
    verifier_cores: float
    memory_mib: float
    unbuffered: int
    incomplete: int
    slowest_sync_ms: float

    @property
    def clean(self) -> bool:
        bad = self.lost, self.reordered, self.dropped, self.wrong, self.states_lost
        return not any(bad) and self.verified == self.sent


HEADER = (
    "asked fps|s|frames sent|fps|lost|reordered|dropped|verified|wrong|states|states lost"
    "|CPU station|CPU simulator|CPU verifier|memory|slowest sync"
)


def row(outcome: Outcome) -> str:
    """Of the table under `HEADER`."""
    o, fps = outcome, outcome.sent / outcome.seconds
    cells = (
        f"{o.asked_fps:g}|{o.seconds:.0f}|{o.sent}|{fps:.1f}|{o.lost}|{o.reordered}|{o.dropped}"
        f"|{o.verified}|{o.wrong}|{o.states}|{o.states_lost}|{o.station_cores:.2f} cores"
        f"|{o.simulator_cores:.2f} cores|{o.verifier_cores:.2f} cores|{o.memory_mib:.0f} MiB"
        f"|{o.slowest_sync_ms:.0f} ms"
    )
    return f"| {cells.replace('|', ' | ')} |"


def run() -> str:
    rows = [row(measure(75.0, 60 * SHARE)), row(measure(150.0, 120 * SHARE))]
    header = f"| {HEADER.replace('|', ' | ')} |"
    return "\n".join([header, "|" + "---|" * (HEADER.count("|") + 1), *rows])


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
        self._folder, self._frames_per_file = folder, frames_per_file
        self._lock = threading.Lock()
        self._recorder = self._open(0)
        self._opener = ThreadPoolExecutor(1)
        self._opening = self._opener.submit(self._open, 1)
        self._verifier = ProcessPoolExecutor(1, initializer=os.nice, initargs=(19,))
        self._verifier.submit(int).result()  # forked before there is much to share
        self._finished: list[Future[tuple[int, int, int]]] = []
        self.first_number = self._last_number = -1
        self.received = self.reordered = self.dropped = self.states = 0
        self.slowest_sync_s = 0.0

    def picture(self, picture: Picture) -> None:
        if self.received and self.received % self._frames_per_file == 0:
            self._next()
        number = number_of(picture)
        if not self.received:
            self.first_number = number
        self.reordered += number <= self._last_number
        self._last_number = number
        self.received += 1
        self._recorder.picture(picture)

    def state(self, state: RobotState) -> None:
        with self._lock:
            self.states += 1
            self._recorder.robot_state(state)
        self.slowest_sync_s = max(self.slowest_sync_s, self._recorder.last_sync_s)

    def finish(self) -> tuple[int, int, int]:
        """Pictures verified, how many of them were wrong, robot states in the files."""
        self._seal(self._recorder)
        self._seal(self._opening.result())
        self._opener.shutdown()  # the opener also hands sealed files to the verifier
        results = [verified.result() for verified in self._finished]
        self._verifier.shutdown()
        return sum(r[0] for r in results), sum(r[1] for r in results), sum(r[2] for r in results)

    def _next(self) -> None:
        with self._lock:
            full, self._recorder = self._recorder, self._opening.result()
        self._seal(full)
        number = self.received // self._frames_per_file + 1
        self._opening = self._opener.submit(self._open, number)

    def _open(self, number: int) -> Recorder:
        info = SessionInfo("bench", "eye-in-hand", "simulated", PAPER_BOARD, CameraModel(1280, 1024))
        return Recorder(self._folder / f"{number}.mcap", info)

    def _seal(self, recorder: Recorder) -> None:
        sealed = recorder.finish()

        def hand_over() -> None:
            path = sealed.result()
            self.dropped += recorder.dropped
            self._finished.append(self._verifier.submit(verify, path))

        self._opener.submit(hand_over)


def number_of(picture: Picture) -> int:
    return int.from_bytes(picture.image.reshape(-1)[:8].tobytes(), "little")


def verify(path: Path) -> tuple[int, int, int]:
    """Pictures in the file, how many are not what the simulator sent, robot states; deletes the file."""
    part = open_recording(path).parts[0]
    sequences = part.picture_sequences()
    wrong = 0
    previous: tuple[int, int] | None = None
    for sequence in sequences:
        picture = part.picture(sequence)
        number = number_of(picture)
        same = np.array_equal(picture.image, numbered_picture(number, 1280, 1024))
        follows = previous is None or frames_between(previous[0], picture.frame_id) == number - previous[1]
        wrong += not (same and follows)
        previous = picture.frame_id, number
    states = sum(1 for _ in part.robot_states())
    path.unlink()
    return len(sequences), wrong, states


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
    server.inject("register", [genicam.FRAME_PERIOD, int(1e6 / fps)])
    rotation = Rotation(folder, round(FILE_S * fps))
    camera = AravisCamera(CameraConfig(device="127.0.0.1", trigger="free-running", packet_size=8996))
    await camera.open()
    stop = threading.Event()
    states = threading.Thread(target=publish_states, args=(rotation.state, stop))
    states.start()
    before, server_before, start_s = cpu_s(), process_cpu_s(server.process.pid), time.monotonic()
    streaming = asyncio.ensure_future(camera.stream(rotation.picture, stop))
    await asyncio.sleep(seconds)
    server.inject("register", [genicam.ACQUISITION, 0])
    took_s = time.monotonic() - start_s
    used_s, served_s = cpu_s() - before, process_cpu_s(server.process.pid) - server_before
    await asyncio.sleep(LAST_FRAMES_S)
    stop.set()
    await streaming
    states.join()
    memory_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    sent, counts = server.sent() - rotation.first_number, camera.counts().stream
    await camera.close()
    verified, wrong, states_read = await asyncio.to_thread(rotation.finish)
    return Outcome(
        asked_fps=fps,
        seconds=took_s,
        sent=sent,
        lost=sent - rotation.received,
        reordered=rotation.reordered,
        dropped=rotation.dropped,
        verified=verified,
        wrong=wrong,
        states=rotation.states,
        states_lost=rotation.states - states_read,
        station_cores=used_s / took_s,
        simulator_cores=served_s / took_s,
        verifier_cores=resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime / took_s,
        memory_mib=memory_mib,
        unbuffered=counts.unbuffered,
        incomplete=counts.incomplete,
        slowest_sync_ms=1e3 * rotation.slowest_sync_s,
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
