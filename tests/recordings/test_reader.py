"""Foreign files are read in a process of their own, and whatever happens there ends in a coded error."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import textwrap
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import calibrate
from recordings.importers import reader
from recordings.importers.reader import look
from tests.codes import raises
from tests.patience import PATIENCE_S, wait_until

POSES = "\n".join(f"0.{n} 0.2 0.3 0 0 0 1" for n in range(5))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / "poses.txt").write_text(POSES)
    return folder


@pytest.fixture
def library(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch):
    """Let the library that reads .mat files do what is written, in the reader alone."""

    def does(source: str) -> None:
        place = tmp_path / "modules"
        (place / "scipy").mkdir(parents=True)
        (place / "scipy" / "__init__.py").touch()
        body = textwrap.indent(textwrap.dedent(source), "    ")
        (place / "scipy" / "io.py").write_text(f"def loadmat(file):\n{body}\n")
        monkeypatch.syspath_prepend(place)
        (folder / "theirs.mat").write_bytes(b"anything")

    return does


def tables(folder: Path) -> list[int]:
    return [len(table.numbers) for table in look(folder).tables]


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ("import ctypes; ctypes.string_at(0)", "crashed"),
        ("import os; os.kill(os.getpid(), 9)", "crashed"),
        ("return bytearray(2**31)", "memory"),
        ("while True: pass", "time"),
        ("import os; os.write(3, b'x' * 64); os._exit(0)", "no-answer"),
        ("import os; os._exit(0)", "no-answer"),
    ],
)
def test_whatever_a_library_dies_of_is_one_error_that_names_the_file(
    source: str, cause: str, folder: Path, library, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "CPU_LIMIT_S", 3)
    library(source)
    with raises("foreign-file", cause=cause, path=str(folder / "theirs.mat")):
        look(folder)


def test_what_a_library_raises_costs_its_file_alone_which_is_named(folder: Path, library) -> None:
    library("raise KeyError('nobody foresaw this')")
    held = look(folder)
    assert [len(table.numbers) for table in held.tables] == [5]
    assert list(held.unread) == ["theirs.mat"]


def test_what_a_library_prints_is_no_answer(folder: Path, library) -> None:
    library("print('x' * 1000, flush=True)")
    assert tables(folder) == [5]


def test_the_api_is_told_the_same(folder: Path, library) -> None:
    read_folder = calibrate.read_folder  # this imports the true SciPy, before a false one takes its name
    library("import ctypes; ctypes.string_at(0)")
    with raises("foreign-file", cause="crashed"):
        read_folder(folder)


def test_the_reader_reaches_no_network(folder: Path, library) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        library(f"import socket; socket.create_connection(('127.0.0.1', {server.getsockname()[1]}), 5)")
        assert list(look(folder).unread) == ["theirs.mat"]
        with pytest.raises(BlockingIOError):
            server.accept()


def test_the_reader_starts_no_process(folder: Path, tmp_path: Path, library) -> None:
    library(f"import subprocess; subprocess.run(['touch', {str(tmp_path / 'started')!r}])")
    assert list(look(folder).unread) == ["theirs.mat"]
    assert not (tmp_path / "started").exists()


def test_the_reader_ends_with_the_program_that_asked(folder: Path, tmp_path: Path, library) -> None:
    pid_file = tmp_path / "pid"
    modules = sys.path[:]
    library(
        f"""
        import os, time
        open({str(pid_file)!r}, "w").write(str(os.getpid()))
        time.sleep(3600)
        """
    )
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys; sys.path[:] = {modules!r}\n"
        "from pathlib import Path\nfrom recordings.importers.reader import look\n"
        f"sys.path[:] = {sys.path!r}\nlook(Path({str(folder)!r}))\n"
    )
    asking = subprocess.Popen([sys.executable, script])
    wait_until(lambda: pid_file.exists() and pid_file.read_text())
    asking.kill()
    asking.wait(PATIENCE_S)
    state = Path("/proc", pid_file.read_text(), "stat")
    wait_until(lambda: not state.exists() or " Z " in state.read_text())


def test_a_script_without_a_main_guard_and_many_threads_may_read(folder: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys; sys.path[:] = {sys.path!r}\n"
        "from pathlib import Path\nfrom recordings.importers.reader import look\n"
        f"print(len(look(Path({str(folder)!r})).tables))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.stdout.split() == ["1"], done.stderr
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(tables, [folder] * 4)) == [[5]] * 4


def test_a_module_of_the_folder_in_which_the_user_stands_is_never_loaded(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("yaml", "numpy", "msgspec", "recordings"):
        (folder / f"{name}.py").write_text("raise SystemExit(7)")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend("")
    assert tables(folder) == [5]


def test_links_that_leave_the_folder_are_not_followed_but_told(folder: Path) -> None:
    (folder / "everything").symlink_to("/")
    (folder / "inside").mkdir()
    (folder / "again").symlink_to("inside")
    (folder / "round").symlink_to(".")
    held = look(folder)
    assert list(held.unread) == ["everything"]
    assert [len(table.numbers) for table in held.tables] == [5]


def test_no_more_is_unpacked_than_poses_need(folder: Path) -> None:
    with zipfile.ZipFile(folder / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        header = b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '|u1', 'fortran_order': False, 'shape': (80000000,)}"
        archive.writestr("a.npy", header.ljust(127) + b"\n" + bytes(80_000_000))
    (folder / "vast.npy").write_bytes(
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (687194767360, 1)}".ljust(117)
        + b"\n"
    )
    held = look(folder)
    assert sorted(held.unread) == ["bomb.npz", "vast.npy"]
    assert [len(table.numbers) for table in held.tables] == [5]


@pytest.mark.parametrize(
    "line",
    ["x" * 10**6, "1" * 10**6 + "x", "[" * 10**6, "1." * (5 * 10**5), "1e" * (5 * 10**5)],
    ids=["letters", "digits", "brackets", "points", "exponents"],
)
def test_a_line_of_a_megabyte_is_read_like_any_other(line: str, folder: Path) -> None:
    (folder / "notes.txt").write_text(line)
    assert tables(folder) == [5]


@pytest.mark.parametrize(
    "tree",
    [
        {"9" * 5000: [1.0] * 7},
        {"pose": 10**400},
        {"fx": "a", "fy": [], "cx": None, "cy": 1},
        {"a": {"x": 1, "y": 1, "z": float("nan"), "qx": 0, "qy": 0, "qz": 0, "qw": 1}},
        {"columns": 10**30},
    ],
    ids=["digits of a key", "digits of a number", "no lens", "not finite", "a large number"],
)
def test_odd_values_cost_themselves_alone(tree: object, folder: Path) -> None:
    (folder / "odd.json").write_text(json.dumps(tree))
    (folder / "five-thousand.json").write_text(f'{{"a": {"9" * 5000}}}')
    assert tables(folder) == [5]


def test_a_name_that_is_no_text_is_read(folder: Path) -> None:
    (folder / "poses.txt").rename(folder / os.fsdecode(b"poses\xff.txt"))
    assert tables(folder) == [5]


def test_a_python_that_cannot_be_started_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with raises("foreign-file", cause="not-started"):
        look(folder)
