"""`station bootstrap` against a simulated cell: a bad mount guess becomes one good enough to plan from."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import yaml

from calibrate.geometry import difference, pose, pose_from_quaternion, rotation_exp
from recordings.schema.messages import SessionInfo, Source, Vector6
from station.analysis.worker import check_run
from station.cell.errors import ConfigError, LimitError
from station.cell.plan import Plan, PlannedPose
from station.cell.scene import guess_from
from station.cell.status import StationState, StationStatus
from station.cli import bootstrap as cli_bootstrap
from station.cli import main
from station.cli.bootstrap import slow_plan
from station.cli.demo import simulated_daemon
from station.plan.planner import make_plan
from station.protocol.client import Client
from station.simulation.scenes import cell_config, make_cell
from tests.command_line import call

pytestmark = [pytest.mark.process, pytest.mark.timeout(400)]
SEED = 0
TRUTH = make_cell("paper", SEED, "low", "eye-in-hand")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("root")


@pytest.fixture(scope="module")
def socket(root: Path) -> Iterator[Path]:
    """Socket of a simulated daemon, faster than real time."""
    with simulated_daemon(root, ["--seed", str(SEED), "--time-scale", "4"]) as socket:
        yield socket


def test_a_mount_wrong_by_30_degrees_and_100_mm_is_found(socket: Path, root: Path, tmp_path: Path) -> None:
    X = np.array(TRUTH.camera_mount)
    axis = np.array([0.6, -0.64, 0.48])
    wrong = pose(rotation_exp(np.deg2rad(30) * axis) @ X[:3, :3], X[:3, 3] + 0.1 * axis[::-1])
    bad = msgspec.structs.replace(
        cell_config(TRUTH, "127.0.0.1"), camera_guess=guess_from(wrong, 0.06, 0.3), board_guess=None
    )
    config, guesses = tmp_path / "cell.yaml", tmp_path / "guesses.yaml"
    config.write_text(yaml.safe_dump(msgspec.to_builtins(bad)))
    options = ("--config", config, "-o", guesses, "--headless", "--socket", socket)
    done = call(main, "bootstrap", *options)
    assert done.returncode == 0, done.stderr
    found = yaml.safe_load(guesses.read_text())
    assert 4 <= len(list((root / "sessions").iterdir())) <= 6, "the arm moves 3 to 5 times"
    for name, truth in (("camera_guess", TRUTH.camera_mount), ("board_guess", TRUTH.board_place)):
        guess = found[name]
        off = difference(
            pose_from_quaternion(guess["translation_m"], guess["rotation_xyzw"]), np.array(truth)
        )
        assert np.linalg.norm(off[:3]) < 0.02, name
        assert np.rad2deg(np.linalg.norm(off[3:])) < 2, name
    improved = msgspec.convert({**msgspec.to_builtins(bad), **found}, type(bad))
    assert len(make_plan(improved, start_joints_rad=TRUTH.start_joints_rad, count=10).poses) == 10


def test_ctrl_c_in_mid_move_stops_the_arm_and_says_so(socket: Path, tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    other = cell_config(make_cell("paper", SEED, "low", "eye-to-hand"), "127.0.0.1")
    config.write_text(yaml.safe_dump(msgspec.to_builtins(other)))
    refused = call(main, "bootstrap", "--config", config, "--headless", "--socket", socket)
    assert refused.returncode == 2, "a configuration of the other mounting"
    config.write_text(yaml.safe_dump(msgspec.to_builtins(cell_config(TRUTH, "127.0.0.1"))))
    command = [sys.executable, "-m", "station.cli", "bootstrap", "--config", str(config), "--headless"]
    bootstrap = subprocess.Popen([*command, "--socket", str(socket)], stderr=subprocess.PIPE, text=True)

    async def strike() -> StationStatus:
        """In the first real move; the status in which the arm is at rest."""
        async with asyncio.timeout(60), await Client.connect(socket) as client:
            async for status in client.statuses():
                if status.state is StationState.MOVING and status.robot.speed_m_s > 0.01:
                    bootstrap.send_signal(signal.SIGINT)
                    break
            async for status in client.statuses():
                if status.state is StationState.STOPPED and status.robot.still:
                    return status
        raise AssertionError("the daemon ended")

    status = asyncio.run(strike())
    said = bootstrap.communicate(timeout=20)[1]
    assert bootstrap.returncode == 130 and "station acknowledge" in said
    assert status.cause == "stop" and not status.robot.control
    assert [pose.state for pose in status.session.poses] == ["planned"]


@pytest.mark.parametrize(
    ("source", "sha256", "square_m", "same"),
    [
        ("real", "ab", 0.025, True),
        ("real", "cd", 0.025, False),
        ("simulated", "cd", 0.025, True),
        ("simulated", "cd", 0.030, False),
    ],
)
def test_a_file_that_the_daemon_does_not_run_with_is_refused(
    source: Source, sha256: str, square_m: float, same: bool
) -> None:
    """Its moves would be chosen for another cell than they are checked in."""
    cell = cell_config(TRUTH, "127.0.0.1")
    board = msgspec.structs.replace(cell.board, square_m=square_m)
    info = SessionInfo("s", cell.mount, source, board, TRUTH.camera, config_sha256=sha256)
    if same:
        cli_bootstrap.require_same_cell(cell, "ab", info)
        return
    with pytest.raises(ConfigError) as refused:
        cli_bootstrap.require_same_cell(cell, "ab", info)
    assert refused.value.code == "other-cell"


def test_what_was_found_is_kept_when_no_further_move_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    config, start = cell_config(TRUTH, "127.0.0.1"), TRUTH.start_joints_rad
    moves = [PlannedPose("bootstrap 1", start), LimitError("nothing is free")]

    async def standing(*_: object) -> Vector6:
        return start

    def next_move(*_: object) -> PlannedPose:
        move = moves.pop(0)
        if isinstance(move, LimitError):
            raise move
        return move

    def pictures(*_: object) -> SimpleNamespace:
        return SimpleNamespace(camera_from_board=np.eye(4)[None].repeat(3 - len(moves), axis=0))

    monkeypatch.setattr(cli_bootstrap, "_standing", standing)
    monkeypatch.setattr(cli_bootstrap, "_take", lambda *_: (np.array(start), None))
    monkeypatch.setattr(cli_bootstrap, "solve_pnp", pictures)
    monkeypatch.setattr(cli_bootstrap, "next_move", next_move)
    assert len(cli_bootstrap._make_moves(config, Path("socket"), headless=True)) == 2
    with pytest.raises(LimitError):
        moves[:] = [LimitError("nothing is free")]
        monkeypatch.setattr(
            cli_bootstrap, "solve_pnp", lambda *_: SimpleNamespace(camera_from_board=np.eye(4)[None])
        )
        cli_bootstrap._make_moves(config, Path("socket"), headless=True)


def test_its_moves_are_slower_than_those_of_a_plan() -> None:
    """The speed limit holds for the modelled camera; the true one may be 100 mm from there."""
    config = cell_config(TRUTH, "127.0.0.1")
    a, *others = TRUTH.start_joints_rad
    move = PlannedPose("bootstrap 1", (a + 0.3, *others))
    usual = check_run(config, Plan(config.robot.model, config.mount, (move,)), TRUTH.start_joints_rad)
    slow = check_run(config, slow_plan(config, move), TRUTH.start_joints_rad)
    assert not slow.problems
    assert slow.moves[0].joint_speed_rad_s <= 0.2 < usual.moves[0].joint_speed_rad_s
    assert slow.top_speed_m_s < 0.75 * usual.top_speed_m_s


def test_without_a_mount_guess_nothing_is_asked_of_the_arm(tmp_path: Path) -> None:
    config = tmp_path / "cell.yaml"
    blind = msgspec.structs.replace(cell_config(TRUTH, "127.0.0.1"), camera_guess=None, board_guess=None)
    config.write_text(yaml.safe_dump(msgspec.to_builtins(blind)))
    done = call(main, "bootstrap", "--config", config, "--socket", tmp_path / "none")
    assert done.returncode == 2
