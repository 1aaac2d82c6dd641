"""`station plan` as a person and as a script see it, and what it leaves on the disk."""

from __future__ import annotations

import json
from functools import partial

import msgspec
import numpy as np
import pytest

from station.cli import main
from station.plan.files import load_plan, save_plan
from station.simulation.cells import cell_config, make_cell
from tests.command_line import call

run = partial(call, main, "plan")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    return run("--poses", 12, "-o", folder / "plan.yaml"), folder / "plan.yaml"


def test_a_plan_is_made_shown_and_saved(made):
    result, file = made
    assert result.returncode == 0, result.stderr
    assert "12 poses" in result.stdout and "check: passed" in result.stdout and "SIMULATED" in result.stderr
    plan = load_plan(file)
    assert len(plan.poses) == 12
    rows = [line for line in result.stdout.splitlines() if line.startswith(tuple(p.name for p in plan.poses))]
    assert 0.0 < plan.floor_m < plan.predicted_error_m(-1) < plan.predicted_error_m(5)
    assert len(rows) == 12 and all(pose.why[:20] in row for pose, row in zip(plan.poses, rows, strict=True))


def test_a_plan_passes_the_check_and_an_edited_one_that_hits_something_fails_it_with_1(made, tmp_path):
    good = run("--check", made[1], "--json")
    summary = json.loads(good.stdout)
    assert (good.returncode, summary["poses"], summary["problems"]) == (0, 12, [])
    assert summary["top_speed_m_s"] <= 0.25 and summary["duration_s"] > 0
    plan = load_plan(made[1])
    low = np.deg2rad([0.0, -10.0, 40.0, -120.0, -90.0, 0.0])
    bad = msgspec.structs.replace(plan.poses[3], joints_rad=tuple(low.tolist()), base_from_flange=None)
    poses = (*plan.poses[:3], bad, *plan.poses[4:])
    save_plan(msgspec.structs.replace(plan, poses=poses), tmp_path / "bad.yaml")
    result = run("--check", tmp_path / "bad.yaml", "--json")
    assert result.returncode == 1
    summary = json.loads(result.stdout)
    assert {problem["limit"] for problem in summary["problems"]} >= {"clearance"}


def test_checking_needs_no_lens_but_knows_as_the_daemon_does_what_to_keep_clear_of(made, tmp_path):
    config = cell_config(make_cell("paper", 0, "low", "eye-in-hand"), "127.0.0.1")
    blind = msgspec.structs.replace(config, camera=msgspec.structs.replace(config.camera, model=None))
    unplaced = msgspec.structs.replace(config, board_guess=None)
    for cell, code in ((blind, 0), (unplaced, 2)):
        (tmp_path / "cell.yaml").write_bytes(msgspec.yaml.encode(cell))
        found = run("--config", tmp_path / "cell.yaml", "--check", made[1])
        assert found.returncode == code and "SIMULATED" not in found.stderr


def test_only_plans_are_written_over(tmp_path):
    """A slip of the name must not cost a configuration."""
    truth = make_cell("paper", 0, "low", "eye-in-hand")
    config = tmp_path / "cell.yaml"
    config.write_bytes(msgspec.yaml.encode(cell_config(truth, "127.0.0.1")))
    before = config.read_bytes()
    refused = run("--config", config, "-o", config)
    assert refused.returncode == 2 and config.read_bytes() == before


def test_an_aim_that_is_none_is_refused():
    assert run("--for", "wrist").returncode == 2
