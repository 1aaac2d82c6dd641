"""Views that a person excludes: which, by whom, and what all views say; the verdict counts it."""

from __future__ import annotations

import getpass
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.errors import InstallError
from calibrate.files.calibration import Calibration, read_calibration, write_calibration
from calibrate.files.formatting import figures, verdict_text
from calibrate.files.install import install, objections_beside
from calibrate.pipeline.gates import GateLimits
from calibrate.pipeline.job import JobOptions, SolvedRecording, solve_recording
from calibrate.report.page import report_page
from calibrate.results import AllViews, Excluded, RejectedView
from recordings.geometry import difference, perturb
from recordings.reader import open_recording
from recordings.writer import RecordingWriter
from tests.codes import raises


@pytest.fixture(scope="module")
def without(real_session_file: Path) -> SolvedRecording:
    """Fourteen good views, two of them excluded."""
    return solve_recording(real_session_file, JobOptions(without=(5, 2)))


@pytest.fixture(scope="module")
def spoiled_file(real_session_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same session, the robot's pose of view 4 wrong by 30 mm."""
    source = open_recording(real_session_file)
    path = tmp_path_factory.mktemp("spoiled") / "spoiled.mcap"
    with RecordingWriter(path, source.info) as writer:
        for number, (view, picture) in enumerate(source.images(), start=1):
            writer.image(picture)
            off = np.array([0.03, 0, 0, 0, 0, 0]) * (number == 4)
            moved = perturb(np.array(view.base_from_flange), off)
            writer.view(msgspec.structs.replace(view, base_from_flange=tuple(map(tuple, moved.tolist()))))
        return writer.finish()


def test_the_file_says_which_views_by_whom_and_what_all_views_say(
    without: SolvedRecording, solved_real: SolvedRecording, tmp_path: Path
) -> None:
    write_calibration(without.calibration, tmp_path / "c.yaml")
    written = read_calibration(tmp_path / "c.yaml")
    everything = solved_real.calibration
    excluded = written.excluded
    assert excluded.views == written.excluded_views == [1, 4]
    assert excluded.who == getpass.getuser()
    assert not {1, 4} & set(written.views.used)
    all_views = excluded.all_views
    assert all_views.error_mm == pytest.approx(everything.quality.predicted_error_mm, rel=1e-9)
    assert all_views.holdout_m == pytest.approx(everything.quality.holdout.e_t_m, rel=1e-9)
    assert all_views.failed == [gate.name for gate in everything.quality.failed]
    shift = difference(written.transform.matrix, everything.transform.matrix)
    np.testing.assert_allclose(all_views.shift, shift, atol=1e-12)
    residuals = {view.index: view for view in everything.quality.views}
    assert [view.index for view in all_views.views] == [1, 4]
    for view in all_views.views:
        assert view.robot_mm == pytest.approx(residuals[view.index].robot_mm, rel=1e-6)
    assert {weight.index for weight in all_views.weights} == {1, 4}


def test_a_solve_of_all_views_has_no_such_part(solved_real: SolvedRecording) -> None:
    assert solved_real.calibration.excluded is None
    assert "excluded" not in verdict_text(solved_real.calibration)


def test_the_first_line_and_the_figures_say_it(without: SolvedRecording) -> None:
    calibration = without.calibration
    assert verdict_text(calibration).startswith("PASS, 2 views excluded by a person: ")
    told = figures(calibration)
    assert "12" in told["views"].value and "2 excluded" in told["views"].about
    assert "of all views" in told["held_out"].about
    page = report_page(without)
    assert "PASS, 2 views excluded by a person" in page
    assert f"Excluded by {getpass.getuser()}: pose 2, 5." in page


def with_excluded(calibration: Calibration, count: int, all_views: AllViews, used: int = 20) -> Calibration:
    """The result of `used` views, where a person excluded `count` others."""
    rejected = [RejectedView(used + i, f"p{i}", "excluded by a person", "by-hand") for i in range(count)]
    views = msgspec.structs.replace(calibration.views, used=list(range(used)), rejected=rejected)
    excluded = Excluded([view.index for view in rejected], "anna", all_views)
    return msgspec.structs.replace(calibration, views=views, excluded=excluded)


@pytest.mark.parametrize(
    ("count", "all_views", "verdict"),
    [
        (1, AllViews(), "PASS"),
        (5, AllViews(), "PASS"),  # exactly a fifth of 25
        (6, AllViews(), "PASS WITH A REASON"),
        (1, AllViews(failed=["predicted_error_m"]), "PASS WITH A REASON"),
        (1, AllViews(problem="Views 3 and 4 are one."), "PASS WITH A REASON"),
    ],
)
def test_too_many_or_needed_exclusions_pass_only_with_a_reason(
    solved_real: SolvedRecording, tmp_path: Path, count: int, all_views: AllViews, verdict: str
) -> None:
    calibration = with_excluded(solved_real.calibration, count, all_views)
    assert calibration.verdict == verdict
    path = tmp_path / "c.yaml"
    write_calibration(calibration, path)
    needs_reason = verdict != "PASS"
    assert bool(objections_beside(calibration, tmp_path / "root")) == needs_reason
    if needs_reason:
        with raises("objection", InstallError):
            install(path, tmp_path / "root")
        made = install(path, tmp_path / "root", override="View 3 was taken while the board was touched.")
        assert read_calibration(made.path).override.overridden
    else:
        assert install(path, tmp_path / "root").number == 1


def test_a_failed_gate_stays_a_failure(solved_real: SolvedRecording) -> None:
    """Who excludes views gets no way round a gate."""
    failed = solved_real.calibration.quality.gates[:1]
    failed = [msgspec.structs.replace(gate, passed=False) for gate in failed]
    quality = msgspec.structs.replace(solved_real.calibration.quality, gates=failed)
    calibration = msgspec.structs.replace(solved_real.calibration, quality=quality)
    excluded = with_excluded(calibration, 1, AllViews(failed=["views"]))
    assert excluded.verdict == "FAIL"
    assert verdict_text(excluded).startswith("FAIL, 1 view excluded by a person: ")


def test_what_passes_only_without_a_wrong_pose_asks_for_a_reason(spoiled_file: Path) -> None:
    """In the session of the fixture the solver rejects it alone, and says so by the mean weight."""
    limits = GateLimits(weight=0.95, predicted_error_m=0.01)
    everything = solve_recording(spoiled_file, JobOptions(limits=limits)).calibration
    assert [gate.name for gate in everything.quality.failed] == ["weight"]
    calibration = solve_recording(spoiled_file, JobOptions(limits=limits, without=(4,))).calibration
    assert calibration.excluded.all_views.failed == ["weight"]
    assert calibration.excluded.all_views.weights[0].weight < 0.05
    assert not calibration.quality.failed and calibration.verdict == "PASS WITH A REASON"


def test_all_views_may_give_no_result(real_session_file: Path, tmp_path: Path) -> None:
    """A picture that was taken twice is refused; without its copy it is solved, and that is said."""
    source = open_recording(real_session_file)
    pairs = list(source.images())
    with RecordingWriter(tmp_path / "twice.mcap", source.info) as writer:
        for view, picture in pairs:
            writer.image(picture)
            writer.view(view)
        view, picture = pairs[2]
        last = len(pairs)
        writer.image(msgspec.structs.replace(picture, sequence=last, frame_id=last))
        writer.view(msgspec.structs.replace(view, index=last, name="again", picture_sequence=last))
        path = writer.finish()
    calibration = solve_recording(path, JobOptions(without=(15,))).calibration
    assert calibration.excluded.all_views.problem
    assert calibration.excluded.all_views.shift == ()
    assert calibration.verdict == "PASS WITH A REASON"
