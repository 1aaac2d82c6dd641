"""Mutated foreign files for every importer and reader: what a library raises or dies of must stay an error.

`python -m tests.faults.mutated_files --cases 6000 --seed 1` is the whole run, `test_mutated_files.py` takes
a share. Files that the reader's process reads are read here by the code of that process, many cases
in one process with the same limits, and a share of them through the functions that a program calls. A case in
which a process dies is read again through those functions, which must turn it into an error with a code.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.io import savemat

import recordings
from calibrate.errors import CalibrationError
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.imported import Given, believe
from calibrate.pipeline.job import solve_recording
from recordings.errors import CodedError
from recordings.image_headers import IMAGE_LIMIT_BYTES, ImageError, read_header
from recordings.images import decode_image
from recordings.importers import reader, reader_main
from recordings.importers.bag import import_bag
from recordings.importers.folder import import_folder
from recordings.importers.reader_messages import Broken, LookInto, ReadBag, ReadDescribed, Request
from recordings.importers.stops import StandstillLimits
from recordings.reader import open_recording
from tests.foreign.bags import (
    write_foxglove_mcap,
    write_ros_mcap,
    write_rosbag1,
    write_rosbag2,
)
from tests.recordings.small_recording import write_small

CASE_LIMIT_S = 20.0
BATCH = 40
_DATASET = """mount: eye-in-hand
board: {kind: chessboard, columns: 7, rows: 6, square_m: 0.025}
camera: {width: 8, height: 6}
"""


@dataclass(frozen=True)
class Target:
    """A kind of file, how a whole one is made, and what reads it."""

    name: str
    write: Callable[[Path], Path]
    """Writes into an empty folder; returns the file that is mutated."""
    request: Callable[[Path], Request] | None
    """What the reader's process is asked; None: the file is read by the process that imports."""
    call: Callable[[Path], object]
    """The function that a program calls, with the folder."""


@dataclass(frozen=True)
class Outcome:
    """One case."""

    target: str
    number: int
    end: str
    """read, coded (by a code), caught (the reader caught what a library raised), traceback or death."""
    cpu_s: float
    said: str = ""


def poses(n: int = 12) -> list[list[float]]:
    """Rows x, y, z, qx, qy, qz, qw."""
    rng = np.random.default_rng(1)
    turns = rng.normal(size=(n, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return np.round(np.hstack([rng.uniform(-0.5, 0.5, (n, 3)), turns]), 9).tolist()


def _text(name: str, content: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_text(content)
        return folder / name

    return write


def _described(mutated: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / "dataset.yaml").write_text(_DATASET)
        lines = ["image,x,y,z,qx,qy,qz,qw"]
        for n, row in enumerate(poses(4)):
            cv2.imwrite(str(folder / f"{n}.png"), np.full((6, 8), 40 * n, np.uint8))
            lines.append(f"{n}.png," + ",".join(map(str, row)))
        (folder / "poses.csv").write_text("\n".join(lines))
        return folder / mutated

    return write


def _arrays(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path, table = folder / name, np.array(poses())
        if path.suffix == ".npy":
            np.save(path, table)
        elif path.suffix == ".npz":
            save = np.savez_compressed if "packed" in name else np.savez
            save(path, robot_poses=table, K=np.eye(3))
        else:
            savemat(path, {"robot_poses": table, "cell": {"a": table}}, do_compression="packed" in name)
        return path

    return write


def _image(suffix: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder / f"a{suffix}"
        cv2.imwrite(str(path), np.random.default_rng(2).integers(0, 255, (24, 32), np.uint8))
        return path

    return write


def _look(folder: Path) -> Request:
    return LookInto(str(folder), None)


def _bag_of(folder: Path) -> Path:
    found = sorted(path for path in folder.iterdir() if path.name != "dataset.yaml")
    return found[0]


def _bag(folder: Path) -> Request:
    limits = StandstillLimits()
    told = (limits.position_m, limits.rotation_rad, limits.every_image)
    return ReadBag(str(_bag_of(folder)), None, (None,) * 5, told, 0.05, True)


def _import_bag(folder: Path) -> object:
    out = folder.with_name("out.mcap")
    out.unlink(missing_ok=True)
    return import_bag(_bag_of(folder), out)


def _bag_in(write: Callable[[Path], Path]) -> Callable[[Path], Path]:
    def written(folder: Path) -> Path:
        (folder / "dataset.yaml").write_text(_DATASET.rpartition("camera")[0])
        source = write(folder)
        return source if source.is_file() else max(source.iterdir(), key=lambda path: path.stat().st_size)

    return written


def _believed(folder: Path) -> object:
    return believe(reader.look(folder), Given(mount="eye-in-hand"))


def _read_image(folder: Path) -> object:
    (path,) = folder.iterdir()
    data = path.read_bytes()[: IMAGE_LIMIT_BYTES + 1]
    header = read_header(data)
    return decode_image(data, header.width, header.height)


def _recording(folder: Path) -> object:
    (path,) = folder.iterdir()
    recording = open_recording(path)
    return [recording.views(), list(recording.images()), recording.robot_samples()]


def _pairs() -> str:
    """Poses of robot and board of a cell, which agree."""
    rows = []
    X, Y = np.eye(4), np.eye(4)
    X[:3, 3], Y[:3, 3] = [0.02, 0.05, 0.1], [0.6, 0.1, 0.0]
    for x, y, z, qx, qy, qz, qw in poses():
        H = np.eye(4)
        H[:3, :3] = cv2.Rodrigues(np.array([qx, qy, qz]) * 2 * np.arccos(np.clip(qw, -1, 1)))[0]
        H[:3, 3] = [x, y, z]
        C = np.linalg.inv(H @ X) @ Y
        rows.append({"robot_pose": H.tolist(), "marker_pose": C.tolist()})
    return json.dumps(rows)


_ROWS = poses()
_XML = "<o>" + "".join(f"<pose>{' '.join(map(str, row))}</pose>" for row in _ROWS) + "</o>"
_YAML = "robot_poses:\n" + "".join(f"- {row}\n" for row in _ROWS) + "square_size: 0.025\nboard: [9, 6]\n"
_OPENCV = (
    "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [600., 0., 320., 0., 600., 240., 0., 0., 1.]\n"
)
_CSV = "x,y,z,qx,qy,qz,qw\n" + "\n".join(",".join(map(str, row)) for row in _ROWS)
_TXT = "# robot\n" + "\n".join(f"img_{n}.png [{', '.join(map(str, row))}]" for n, row in enumerate(_ROWS))
_JSON = json.dumps({"robot_pose": _ROWS, "fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0, "rows": 6})


def _calibration(folder: Path) -> Path:
    sample = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"
    solved = solve_recording(sample)
    write_calibration(solved.calibration, folder / "a.yaml")
    return folder / "a.yaml"


def _folder_target(name: str, write: Callable[[Path], Path]) -> Target:
    return Target(name, write, _look, _believed)


def _described_target(mutated: str) -> Target:
    def asked(folder: Path) -> Request:
        return ReadDescribed(str(folder), None)

    def imported(folder: Path) -> object:
        out = folder.with_name("out.mcap")
        out.unlink(missing_ok=True)
        return import_folder(folder, out)

    return Target(f"described, {mutated}", _described(mutated), asked, imported)


def _bag_target(name: str, write: Callable[[Path], Path]) -> Target:
    return Target(name, _bag_in(write), _bag, _import_bag)


TARGETS = [
    _folder_target("json", _text("robot.json", _JSON)),
    _folder_target("json of pairs", _text("pairs.json", _pairs())),
    _folder_target("yaml", _text("robot.yaml", _YAML)),
    _folder_target("opencv yaml", _text("camera.yaml", _OPENCV)),
    _folder_target("xml", _text("robot.xml", _XML)),
    _folder_target("csv", _text("robot.csv", _CSV)),
    _folder_target("text", _text("robot.txt", _TXT)),
    _folder_target("npy", _arrays("robot.npy")),
    _folder_target("npz", _arrays("robot.npz")),
    _folder_target("npz, packed", _arrays("packed.npz")),
    _folder_target("mat", _arrays("robot.mat")),
    _folder_target("mat, packed", _arrays("packed.mat")),
    _described_target("dataset.yaml"),
    _described_target("poses.csv"),
    _described_target("0.png"),
    _bag_target("bag of ROS 1", lambda folder: write_rosbag1(folder / "a.bag")),
    _bag_target("bag of ROS 2", lambda folder: write_rosbag2(folder / "bag", "sqlite3")),
    _bag_target("bag of ROS 2, packed", lambda folder: write_rosbag2(folder / "bag", "sqlite3", "file")),
    _bag_target("mcap of ROS 2", lambda folder: write_ros_mcap(folder / "a.mcap")),
    _bag_target(
        "mcap without checksums", lambda folder: write_ros_mcap(folder / "a.mcap", enable_crcs=False)
    ),
    _bag_target("mcap of foxglove", lambda folder: write_foxglove_mcap(folder / "a.mcap")),
    Target("recording", lambda folder: write_small(folder / "a.mcap"), None, _recording),
    Target(
        "calibration",
        _calibration,
        None,
        lambda folder: read_calibration(folder / "a.yaml"),
    ),
    *(
        Target(f"image {suffix}", _image(suffix), None, _read_image)
        for suffix in (".png", ".jpg", ".bmp", ".pgm")
    ),
]
_INTERESTING = [0, 1, 0x7F, 0x80, 0xFF]
_DIGITS = [b"9" * 5000, b"1" * 400, b"1e999", b"nan", b"inf", b"-"]
_SIGNS = [b"[" * 900, b"\0", b"{", b"\xff\xfe", b"'", b"\n"]


def mutated(content: bytes, rng: random.Random) -> bytes:
    """One to four changes: flips, cuts, splices, sizes, repeats and huge numbers."""
    data = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        size = max(1, len(data))
        at = rng.randrange(size)
        match rng.randrange(8):
            case 0 if data:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                del data[at:]
            case 2:
                other = rng.randrange(size)
                data[at:at] = data[other : other + rng.randint(1, 64)]
            case 3:
                length = rng.choice([1, 2, 4, 8])
                data[at : at + length] = rng.choice(
                    [0, 1, 2 ** (8 * length) - 1, 2 ** (8 * length - 1)]
                ).to_bytes(length, "little")
            case 4:
                data[at:at] = data[at : at + rng.randint(1, 32)] * rng.choice([2, 50, 2000])
            case 5:
                data[at:at] = rng.choice(_DIGITS + _SIGNS)
            case 6:
                del data[at : at + rng.randint(1, 64)]
            case _ if data:
                data[at] = rng.choice(_INTERESTING)
    return bytes(data)


def prepare(target: Target, number: int, seed: int, folder: Path) -> None:
    """Write the case's files into an empty folder; the whole ones are made once."""
    whole = folder.with_name(f"whole {TARGETS.index(target)}")
    if not whole.exists():
        whole.mkdir(parents=True)
        (whole / "mutated").write_text(str(target.write(whole).relative_to(whole)))
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder)
    note = folder / "mutated"
    file = folder / note.read_text()
    note.unlink()
    file.write_bytes(mutated(file.read_bytes(), random.Random(f"{seed} {target.name} {number}")))


def read_here(target: Target, folder: Path) -> tuple[str, str]:
    """(end, what was said) of a case that is read in this process."""
    if target.request is None:
        return call(target, folder)
    end = "read"
    try:
        for answer, _ in reader_main.answered(target.request(folder), lambda told: None):
            if isinstance(answer, Broken):
                return "caught", f"{answer.cause} {answer.reason}"
            end = "coded" if type(answer).__name__ == "Refused" else "read"
    except Exception:
        return "traceback", traceback.format_exc()[-1500:]
    return end, ""


def call(target: Target, folder: Path) -> tuple[str, str]:
    """(end, what was said) of the function that a program calls."""
    try:
        target.call(folder)
    except (CodedError, CalibrationError, ImageError) as error:
        return "coded", getattr(error, "code", "")
    except Exception:
        return "traceback", traceback.format_exc()[-1500:]
    return "read", ""


def batch(
    target: Target, numbers: list[int], seed: int, folder: Path, by_call: bool
) -> tuple[list[Outcome], float]:
    """Read cases in one process after the other; returns them and the largest memory of a process, MB."""
    prepare(target, numbers[0], seed, folder)
    waiting = list(numbers)
    outcomes: list[Outcome] = []
    peak_mb = 0.0
    while waiting:
        told, tell = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(told)
            _work(target, waiting, seed, folder, by_call, tell)
        os.close(tell)
        with os.fdopen(told) as lines:
            done = [Outcome(**json.loads(line)) for line in lines if line.endswith("\n")]
        _, status, used = os.wait4(child, 0)
        peak_mb = max(peak_mb, used.ru_maxrss / 1024)
        outcomes += done
        waiting = waiting[len(done) :]
        if waiting and (status or not done):  # it died of the first of these
            outcomes.append(_after_death(target, waiting.pop(0), seed, folder, status))
    return outcomes, peak_mb


def _work(target: Target, numbers: list[int], seed: int, folder: Path, by_call: bool, tell: int) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    if target.request is not None and not by_call:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_DATA, (reader_main.MEMORY_LIMIT_BYTES,) * 2)
    for number in numbers:
        prepare(target, number, seed, folder)
        used_s = int(time.process_time())
        soft = used_s + int(CASE_LIMIT_S)
        resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        begun_s = time.process_time()
        end, said = call(target, folder) if by_call else read_here(target, folder)
        cpu_s = time.process_time() - begun_s
        line = {"target": target.name, "number": number, "end": end, "cpu_s": cpu_s, "said": said}
        os.write(tell, (json.dumps(line) + "\n").encode())
    os._exit(0)


def _after_death(target: Target, number: int, seed: int, folder: Path, status: int) -> Outcome:
    """A death that the reader's process would die, and the caller must survive with a coded error."""
    died = f"signal {status & 0x7F}, exit {status >> 8}"
    if target.request is None:
        return Outcome(target.name, number, "death", 0.0, died)
    prepare(target, number, seed, folder)
    begun_s = time.process_time()
    end, said = call(target, folder)
    return Outcome(target.name, number, end, time.process_time() - begun_s, f"after a death ({died}): {said}")


def run(
    cases: int, seed: int, share_by_call: float, targets: list[Target] = TARGETS
) -> tuple[list[Outcome], float]:
    """So many cases over all targets; returns them and the largest memory of a process, MB."""
    outcomes: list[Outcome] = []
    peak_mb = 0.0
    each = -(-cases // len(targets))
    by_call = int(each * share_by_call)
    with tempfile.TemporaryDirectory() as place:
        for target in targets:
            for called, numbers in _batches(each, by_call):
                found, peak = batch(target, numbers, seed, Path(place) / "case", called)
                outcomes += found
                peak_mb = max(peak_mb, peak)
    return outcomes, peak_mb


def _batches(each: int, by_call: int) -> Iterator[tuple[bool, list[int]]]:
    for called, numbers in ((True, range(by_call)), (False, range(by_call, each))):
        for start in range(0, len(numbers), BATCH):
            yield called, list(numbers[start : start + BATCH])


def main() -> int:
    """Run, print a table by target, and what must not be."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--cases", type=int, default=6000)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument(
        "--by-call", type=float, default=0.05, help="Share through the functions of the API."
    )
    options.add_argument("--only", default="", help="Targets whose names begin so.")
    told = options.parse_args()
    targets = [target for target in TARGETS if target.name.startswith(told.only)]
    outcomes, peak_mb = run(told.cases, told.seed, told.by_call, targets)
    for target in targets:
        own = [outcome for outcome in outcomes if outcome.target == target.name]
        ends = Counter(outcome.end for outcome in own)
        slowest = max(outcome.cpu_s for outcome in own)
        print(f"{target.name:<26} {len(own):>5} {dict(ends)} slowest {slowest:.2f} s")
    children_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"{len(outcomes)} cases, seed {told.seed}, peak {max(peak_mb, children_mb):.0f} MB")
    for said, count in Counter(o.said[:90] for o in outcomes if o.end == "caught").most_common(12):
        print(f"  caught {count}: {said}")
    for outcome in outcomes:
        if outcome.said.startswith("after a death"):
            print(f"  {outcome.target} {outcome.number}: {outcome.end}, {outcome.said[:200]}")
    wrong = [outcome for outcome in outcomes if is_wrong(outcome)]
    for outcome in wrong:
        print(f"{outcome.target} {outcome.number}: {outcome.end}, {outcome.cpu_s:.1f} s\n{outcome.said}")
    return 1 if wrong else 0


def is_wrong(outcome: Outcome) -> bool:
    """A traceback, a crash of the caller, or too long."""
    return outcome.end in ("traceback", "death") or outcome.cpu_s > CASE_LIMIT_S


if __name__ == "__main__":
    sys.exit(main())
