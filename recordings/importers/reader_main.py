"""The process in which foreign files are read: `python -m … CPU_SECONDS PARENT`, started by `reader`.

It limits itself before it loads what reads, takes one request from its stdin, writes its answers to its
stdout, and ends with the process that started it. What a plain folder does not need is loaded where it is
used.
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import msgspec

from recordings.errors import RecordingError
from recordings.importers.reader_messages import (
    Advanced,
    Answer,
    Broken,
    DescribedRead,
    FolderRead,
    HeadersRead,
    LookInto,
    PoseRead,
    ReadBag,
    ReadDescribed,
    ReadHeaders,
    Reading,
    Refused,
    Request,
    TableRead,
    packed,
    read_frame,
)

MEMORY_LIMIT_BYTES = 480 * 1024 * 1024
"""Data of the process, without the files that it maps."""
DISK_LIMIT_BYTES = 2 * 1024 * 1024 * 1024
"""Length of a file that it may write: packed bags are unpacked beside other temporary files."""
_CPU_GRACE_S = 2
_PR_SET_PDEATHSIG = 1
_CLONE_NEWUSER = 0x10000000
_CLONE_NEWNET = 0x40000000
_FORBIDDEN = ("socket.", "subprocess.", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pty.")
"""Python's audit events of network and processes."""

Frame = tuple[Answer, Sequence[bytes | memoryview]]
Tell = Callable[[Answer], None]


def main() -> None:
    """Read one request, answer it, end."""
    cpu_limit_s, parent = int(sys.argv[1]), int(sys.argv[2])
    confine(cpu_limit_s)
    _end_with(parent)  # last: the kernel forgets it where a process changes its rights
    out = os.dup(1)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)  # what a library prints is no answer

    def send(answer: Answer, blobs: Sequence[bytes | memoryview] = ()) -> None:
        for part in packed(answer, blobs):
            rest = memoryview(part).cast("B")
            while len(rest):
                rest = rest[os.write(out, rest) :]

    with os.fdopen(0, "rb") as asked:
        plain, _ = read_frame(lambda length: asked.read(length))
    request: Request = msgspec.convert(plain, Request)
    for answer, blobs in answered(request, send):
        send(answer, blobs)


def answered(request: Request, tell: Tell) -> Iterator[Frame]:
    """Yield the answers; whatever goes wrong is the last one. `tell`: takes what is told at once."""
    try:
        yield from _answers(request, tell)
    except RecordingError as error:
        data = error.data
        yield Refused(type(error).__name__, data.code, data.text, data.remedy, data.values), ()
    except MemoryError:
        yield Broken("memory", ""), ()
    except Exception as error:
        yield Broken("raised", f"{type(error).__name__}: {error}"[:300]), ()


def _answers(request: Request, tell: Tell) -> Iterator[Frame]:
    def reading(path: Path) -> None:
        tell(Reading(str(path)))

    match request:
        case LookInto():
            yield _look(request, reading)
        case ReadDescribed():
            yield _described(request, reading)
        case ReadHeaders():
            from recordings.importers.image_files import check_headers

            yield HeadersRead(check_headers(Path(request.folder), request.images, request.size)), ()
        case ReadBag():
            from recordings.importers.bag_views import read_bag

            yield from read_bag(request, lambda done, total, text: tell(Advanced(done, total, text)))


def _look(request: LookInto, reading: Callable[[Path], None]) -> Frame:
    from recordings.importers.tables import look

    found = look(Path(request.source), None if request.poses is None else Path(request.poses), reading)
    answer = FolderRead(
        root=str(found.root),
        images={alike: list(map(str, paths)) for alike, paths in found.images.items()},
        tables=[
            TableRead(
                table.name, table.rotation, table.numbers.shape[1], table.images, table.places, table.files
            )
            for table in found.tables
        ],
        cameras=[(matrix.tolist(), distortion) for matrix, distortion in found.cameras],
        facts=found.facts,
        words=found.words,
        files=found.files,
        described_by=found.described_by,
        unread=found.unread,
        told=None if found.told is None else [found.tables.index(table) for table in found.told],
        told_as=found.told_as,
        short=[(table.name, table.rows) for table in found.short],
    )
    return answer, [table.numbers.tobytes() for table in found.tables]


def _described(request: ReadDescribed, reading: Callable[[Path], None]) -> Frame:
    from recordings import strict_yaml
    from recordings.errors import ImportSourceError
    from recordings.importers.dataset import (
        DATASET_FILE,
        POSES_FILE,
        read_dataset,
        read_pose_lines,
        read_small_file,
    )
    from recordings.importers.image_files import check_headers
    from recordings.schema.messages import ARM_KINEMATICS_NAME, UR_KINEMATICS_NAME

    folder = Path(request.folder)
    if not folder.is_dir():
        raise ImportSourceError("no-folder", path=folder)
    reading(folder / DATASET_FILE)
    dataset, dataset_bytes = read_dataset(folder / DATASET_FILE)
    reading(folder / POSES_FILE)
    lines, poses_bytes = read_pose_lines(folder)
    attached = {DATASET_FILE: dataset_bytes, POSES_FILE: poses_bytes}
    for name in (UR_KINEMATICS_NAME, ARM_KINEMATICS_NAME):  # the arm's table as its maker calibrated it
        if (folder / name).exists():
            attached[name] = read_small_file(folder / name, strict_yaml.LIMIT_BYTES)
    lines = lines[-request.newest :] if request.newest else lines
    if (camera := dataset.camera) is None:
        raise ImportSourceError("dataset-value", path=folder / DATASET_FILE, key="camera")
    images = ((line.line, line.image) for line in lines)
    newest_ns = check_headers(folder, images, (camera.width, camera.height))
    poses = [PoseRead(**vars(line)) for line in lines]
    return DescribedRead(dataset, poses, list(attached), newest_ns), list(attached.values())


def confine(cpu_limit_s: int) -> None:
    """Limit memory, computing time, files and core dumps of this process, and take network from it."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _lower(resource.RLIMIT_DATA, MEMORY_LIMIT_BYTES)
    _lower(resource.RLIMIT_CPU, cpu_limit_s, _CPU_GRACE_S)
    _lower(resource.RLIMIT_FSIZE, DISK_LIMIT_BYTES)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one who started us hears Ctrl-C
    sys.dont_write_bytecode = True
    _leave_network()
    sys.addaudithook(_refuse)


def _lower(kind: int, limit: int, grace: int = 0) -> None:
    """Set a limit; a lower one stays."""
    soft, hard = (at if at != resource.RLIM_INFINITY else sys.maxsize for at in resource.getrlimit(kind))
    resource.setrlimit(kind, (min(limit, soft), min(limit + grace, hard)))


def _leave_network() -> None:
    """Move into a network of its own, which has nothing, where the system lets us."""
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None)
    # not as root: in a namespace of users it could no longer read the files of others
    if libc.unshare(_CLONE_NEWNET) != 0 and os.geteuid() != 0:
        libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET)


def _refuse(event: str, arguments: object) -> None:
    """Refuse sockets and processes of Python's own code, which is no wall against a library's."""
    if event.startswith(_FORBIDDEN):
        raise PermissionError(f"{event} is not for a reader of files")


def _end_with(parent: int) -> None:
    """Let the kernel end this process with the thread that started it and waits for it."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the line above
        os._exit(1)


if __name__ == "__main__":
    main()
