"""Recordings that several tests of this room read; made once."""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec
import pytest

from calibrate.files.calibration import write_calibration
from calibrate.files.install import install
from calibrate.pipeline.job import SolvedRecording, solve_recording
from tests.calibrate.sessions import Scene, shifted, write_session


@pytest.fixture(scope="session")
def session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten rendered views, eye-in-hand, simulated, lens unknown."""
    return write_session(tmp_path_factory.mktemp("session") / "rendered.mcap")


@pytest.fixture(scope="session")
def small_session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five views and a known lens: the least that is solved, for tests of who solves it and what stops it."""
    path = tmp_path_factory.mktemp("small") / "small.mcap"
    return write_session(path, Scene(views=5), known_lens=True)


@pytest.fixture(scope="session")
def real_session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, but stamped as captured on a real cell, and enough views for every gate."""
    path = tmp_path_factory.mktemp("real") / "real.mcap"
    return write_session(path, Scene(views=14), known_lens=True, source="real")


@pytest.fixture(scope="session")
def solved(session_file: Path) -> SolvedRecording:
    return solve_recording(session_file)


@pytest.fixture(scope="session")
def solved_real(real_session_file: Path) -> SolvedRecording:
    return solve_recording(real_session_file)


@pytest.fixture(scope="session")
def real_file(solved_real: SolvedRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration file of the real session."""
    path = tmp_path_factory.mktemp("calibration") / "real.yaml"
    write_calibration(solved_real.calibration, path)
    return path


@pytest.fixture
def own_file(real_file: Path, tmp_path: Path) -> Path:
    """The same, for a test that changes it."""
    return Path(shutil.copy(real_file, tmp_path / "cell.yaml"))


@pytest.fixture
def make_file(solved_real: SolvedRecording, tmp_path: Path):
    """make_file(shift_m, **changes) → path of a file like the real one, without its long posterior."""
    count = 0

    def make(shift_m: float = 0.0, **changes: object) -> Path:
        nonlocal count
        count += 1
        moved = msgspec.structs.replace(shifted(solved_real.calibration, shift_m), posterior=None)
        if changes.get("mount") == "eye-to-hand":
            changes["result"] = msgspec.structs.replace(moved.result, parent_frame="base")
        path = tmp_path / f"made-{count}.yaml"
        write_calibration(msgspec.structs.replace(moved, **changes), path)
        return path

    return make


@pytest.fixture
def root(make_file, tmp_path: Path) -> Path:
    """A state folder with one installed."""
    install(make_file(), tmp_path / "s")
    return tmp_path / "s"
