"""Causes named to people: robot poses that contradict themselves, a lens counted elsewhere."""

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from benchmarks.scene import PAPER_CAMERA
from calibrate.gates import Evidence, GateLimits, judge
from calibrate.geometry import rotation_exp
from calibrate.pnp import solve_pnp
from calibrate.solve import SolveOptions, solve_views
from tests.calibrate.cells import LOW, MID, error_mm_deg, make_cell, with_flange

QUICK = SolveOptions(holdout=False)


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_orientations_turned_against_positions_are_said(mount):
    c = make_cell(np.random.default_rng(1), 25, MID, mount=mount)
    assert solve_views(c.views, QUICK).frames_finding == ""
    flange = c.views.base_from_flange
    flange[:, :3, :3] = rotation_exp(np.radians([0.9, -0.6, 0.5])) @ flange[:, :3, :3]
    solution = solve_views(with_flange(c.views, flange), QUICK)
    assert "turned by 1.2" in solution.frames_finding or "turned by 1.1" in solution.frames_finding
    assert solution.frames_finding in solution.warnings
    gates = judge(solution, Evidence(), GateLimits(agreement_sigma=1.0))
    (agreement,) = [gate for gate in gates if gate.name == "agreement"]
    assert not agreement.passed
    assert "orientations contradict its positions" in agreement.text


def moved_centre(views, by_px, width=None):
    (fx, s, cx), (_, fy, cy), last = views.camera.matrix
    camera = msgspec.structs.replace(
        views.camera, matrix=((fx, s, cx + by_px), (0.0, fy, cy + by_px), last), width=width or 1280
    )
    return solve_pnp(replace(views, camera=camera))


@pytest.mark.parametrize(("offset", "says"), [(1.0, "counted as 1"), (0.5, "corner of the first pixel")])
def test_a_principal_point_counted_from_another_origin_is_said(offset, says):
    c = make_cell(np.random.default_rng(2), 25, LOW)
    assert PAPER_CAMERA.matrix[0][2] == (PAPER_CAMERA.width - 1) / 2
    assert solve_views(c.views, QUICK).warnings == ()
    (warning,) = solve_views(moved_centre(c.views, offset), QUICK).warnings
    assert says in warning
    assert f"Subtract {offset:g} from cx and cy" in warning
    assert "exact middle" in warning


def test_nine_views_are_too_few_to_blame_a_lens():
    views = moved_centre(make_cell(np.random.default_rng(2), 25, LOW).views, 1.0)
    assert solve_views(views.select(list(range(9))), QUICK).warnings == ()
    assert len(solve_views(views.select(list(range(10))), QUICK).warnings) == 1


def test_a_middle_that_the_pictures_confirm_is_left_alone():
    """Half the width is a fine principal point where it is the true one."""
    c = make_cell(np.random.default_rng(2), 25, LOW)
    as_if_larger = moved_centre(c.views, 0.0, width=1279)
    assert solve_views(as_if_larger, QUICK).warnings == ()


def test_a_wrong_focal_length_is_said_with_what_it_costs():
    c = make_cell(np.random.default_rng(2), 25, LOW)
    (fx, s, cx), (_, fy, cy), last = c.views.camera.matrix
    camera = msgspec.structs.replace(
        c.views.camera, matrix=((1.004 * fx, s, cx), (0.0, 1.004 * fy, cy), last)
    )
    solution = solve_views(solve_pnp(replace(c.views, camera=camera)), QUICK)
    (said,) = [text for text in solution.warnings if "The given intrinsics do not fit" in text]
    told_mm = float(re.search(r"would move X by ([\d.]+) mm", said)[1])
    assert told_mm == pytest.approx(error_mm_deg(solution.matrix, c.X)[0], rel=0.2)
    assert float(re.search(r"misfit ([\d.]+) times", said)[1]) > 1
