"""The figures of a calibration file are those of the solution, in the units that its fields name."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.lens.pnp import view_rms_px
from calibrate.pipeline.job import SolvedRecording
from calibrate.views.projection import intrinsics_names


def test_figures_are_the_solutions_in_the_units_that_their_names_say(solved_real: SolvedRecording) -> None:
    file = solved_real.calibration
    quality = file.quality
    found = solved_real.solution
    noise = found.fit.noise
    np.testing.assert_allclose(file.transform.matrix, found.matrix, atol=1e-12)
    np.testing.assert_allclose(file.covariance, found.covariance)
    # Sigmas are the covariance's own: roots of the traces of its blocks.
    moved, turned = (np.sqrt(np.trace(found.covariance[part, part])) for part in (slice(3), slice(3, 6)))
    same = [
        (file.confidence_threshold, found.fit.confidence_threshold),
        (quality.gates, list(solved_real.gates)),
        (quality.rms_px, found.judgement.figures.rms_px),
        (quality.board_spread_mm, found.judgement.figures.board_spread_mm),
        (quality.board_spread_deg, found.judgement.figures.board_spread_deg),
        (quality.predicted_error_mm, found.judgement.figures.predicted_error_mm),
        (quality.working_distance_m, found.judgement.figures.working_distance_m),
        (quality.weakest, found.judgement.observability.weakest_text),
        (quality.board, found.fit.board),
        (quality.cross_validation, found.judgement.figures.cross_validation),
        (quality.noise["corner_px"], noise.corner_px),
        (quality.error_shares, found.judgement.figures.error_shares),
    ]
    milli = [
        (file.sigma.translation_mm, moved),
        (quality.noise["robot_mm"], noise.robot_m),
    ]
    degrees = [
        (file.sigma.rotation_deg, turned),
        (quality.noise["robot_deg"], noise.robot_rad),
    ]
    assert [a for a, _ in same] == [b for _, b in same]
    assert [a for a, _ in milli] == pytest.approx([1000 * b for _, b in milli])
    assert [a for a, _ in degrees] == pytest.approx([np.degrees(b) for _, b in degrees])
    assert sum(quality.error_shares.values()) == pytest.approx(1.0)


def test_a_given_lens_is_called_given_and_judged_by_these_pictures(solved_real: SolvedRecording) -> None:
    lens, views = solved_real.calibration.intrinsics, solved_real.views
    found = solved_real.solution
    assert solved_real.intrinsics is None and lens.found == "given"
    assert "coverage" not in {gate.name for gate in solved_real.gates}
    assert list(lens.sigma.values()) == pytest.approx(np.sqrt(np.diag(found.fit.lens_covariance)))
    # A given lens is what is known beforehand, no constant: 0.2 % of it, and the pictures say the rest.
    assert lens.matrix == found.fit.camera.matrix != views.camera.matrix
    assert 0 < lens.sigma["fx"] < 0.002 * lens.matrix[0][0]
    squares = [view_rms_px(v, views.camera, v.camera_from_board) ** 2 for v in views]
    assert lens.rms_px == pytest.approx(np.sqrt(np.mean(squares)))


def test_a_lens_of_these_pictures_is_called_so_with_its_sigmas(solved: SolvedRecording) -> None:
    lens, found = solved.calibration.intrinsics, solved.intrinsics
    assert (lens.found, lens.rms_px) == ("from these pictures", found.rms_px)
    assert set(lens.sigma) == set(intrinsics_names(lens.model)) and lens.sigma["fx"] > 0
    assert lens.matrix == solved.solution.fit.camera.matrix
