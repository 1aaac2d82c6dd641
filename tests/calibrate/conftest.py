"""Recordings that several tests of this room read; made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibrate.calibration import write_calibration
from calibrate.pipeline import SolvedRecording, solve_recording
from tests.calibrate.sessions import Scene, write_session


@pytest.fixture(scope="session")
def session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten rendered views, eye-in-hand, simulated, lens unknown."""
    return write_session(tmp_path_factory.mktemp("session") / "rendered.mcap")


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
