"""Production pictures of one fixed tag: a camera that moved is noticed, one that did not is left alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibrate.check.history import read_checks
from calibrate.check.production import EARLIER, NEWEST, EarlierPictures, check_production
from calibrate.cli import main
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.files.calibration import read_calibration
from calibrate.files.install import install
from calibrate.files.loader import load_installed
from calibrate.files.validity import ValidityState
from calibrate.handeye.posterior import KnownCell
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.views.view_set import ViewSet
from recordings.geometry import inverse, perturb, pose, quaternion_from_matrix, rotation_exp
from recordings.schema.messages import BoardKind, BoardSpec
from station.simulation.renderer import render
from tests.calibrate.chains import ArmCell, arm_cell, later_views
from tests.calibrate.sessions import LIGHT, looking
from tests.codes import raises
from tests.command_line import call

TAG = BoardSpec(BoardKind.APRIL_TAG, square_m=0.05)
TAG_PLACE = pose(rotation_exp([np.pi, 0.1, 0.2]), [0.6, 0.0, 0.05])
STILL = np.zeros(6)


@pytest.fixture(scope="module", params=["eye-in-hand", "eye-to-hand"])
def cell(request: pytest.FixtureRequest) -> ArmCell:
    return arm_cell("seven joints", request.param, 0.2, 31)


def four_corners(views: ViewSet) -> ViewSet:
    """The same pictures of a tag: only the outermost corners of the board."""
    few = [0, 8, 54, 62]
    small = (replace(v, corners=v.corners.part(few)) for v in views)
    return replace(views, views=tuple(small))


def test_a_shift_is_noticed_within_ten_pictures_and_nothing_else(cell: ArmCell) -> None:
    solution = solve_views(cell.views, SolveOptions(holdout=False, folds=False))
    known = KnownCell.of(solution.fit.posterior, solution.fit.camera).with_board(BoardTolerance())
    before = four_corners(later_views(cell, STILL, 1, EARLIER))
    earlier = EarlierPictures.of(before, known)
    after = four_corners(later_views(cell, STILL, 2, 30))
    assert all(earlier.test(after.select(list(range(n)))).passed for n in (3, 10, 30))
    moved = four_corners(later_views(cell, np.r_[1.5e-3, np.zeros(5)], 2, 10))
    found = earlier.test(moved)
    assert not found.passed and found.shift_mm == pytest.approx(1.5, abs=0.4)
    blurred = list(after)
    corners = after.views[1].corners
    off = corners.pixels + np.array([2.0, -1.0])
    blurred[1] = replace(after.views[1], corners=replace(corners, pixels=off))
    assert earlier.test(replace(after, views=tuple(blurred[:3]))).passed  # one of three is no move
    stuck = replace(before, views=(*before.views, *(after.views[0],) * 3))
    with raises("view-twice", BadViewsError):
        check_production(stuck, known)
    for count in (EARLIER - 1, EARLIER, EARLIER + NEWEST[0] - 1):
        with raises("too-few-views", TooFewViewsError, needed=EARLIER + NEWEST[0]):
            check_production(replace(before, views=(*before.views, *after.views)[:count]), known)


class Production:
    """A folder of pictures of one tag that a program adds to; the camera may move."""

    def __init__(self, folder: Path, root: Path, robot: dict[str, str] | None = None) -> None:
        found = load_installed(root)
        self.folder, self.lens, self.X = folder, found.intrinsics.model, found.transform.matrix
        self.rng = np.random.default_rng(7)
        self.count = 0
        seen = [looking(TAG, self.rng, roll_rad=2.0) for _ in range(6)]
        self.flanges = [TAG_PLACE @ inverse(C) @ inverse(self.X) for C in seen]
        folder.mkdir()
        stated = {
            "mount": "eye-in-hand",
            "board": {"kind": "april-tag", "square_m": 0.05, "id": 0},
            "camera": {"width": self.lens.width, "height": self.lens.height},
        }
        if robot is not None:
            stated["robot"] = robot
        (folder / "dataset.yaml").write_text(yaml.safe_dump(stated))
        (folder / "poses.csv").write_text("image,x,y,z,qx,qy,qz,qw\n")

    def take(self, pictures: int) -> None:
        for _ in range(pictures):
            F = self.flanges[self.count % len(self.flanges)]
            true = perturb(F, self.rng.normal(size=6) * np.repeat([2e-5, 2e-5], 3))
            name = f"{self.count:04}.png"
            seen = render(self.lens, TAG, inverse(true @ self.X) @ TAG_PLACE, LIGHT, self.rng)
            cv2.imwrite(str(self.folder / name), seen)
            numbers = [*F[:3, 3], *quaternion_from_matrix(F[:3, :3])]
            with (self.folder / "poses.csv").open("a") as file:
                file.write(",".join([name, *(repr(float(x)) for x in numbers)]) + "\n")
            self.count += 1


@pytest.fixture
def root(real_file: Path, tmp_path: Path) -> Path:
    install(real_file, tmp_path / "s")
    return tmp_path / "s"


def test_a_folder_that_grows_puts_a_moved_camera_in_doubt(root: Path, tmp_path: Path) -> None:
    production = Production(tmp_path / "pictures", root)
    production.take(EARLIER + 5)
    still = call(main, "drift-check", production.folder, "--root", root, "--json")
    assert still.returncode == 0 and json.loads(still.stdout)["validity"] is None
    assert load_installed(root).validity.state is ValidityState.VALID
    production.X = perturb(production.X, np.array([0.002, -0.001, 0, 0, 0, 0.002]))
    production.take(10)
    moved = call(main, "drift-check", production.folder, "--root", root, "--json")
    told = json.loads(moved.stdout)
    assert moved.returncode == 4 and not told["passed"] and told["views"] <= 10
    assert told["validity"]["state"] != ValidityState.VALID and not read_checks(root)
    few = Production(tmp_path / "few", root)
    few.take(4)
    assert call(main, "drift-check", few.folder, "--root", root).returncode == 1


def test_pictures_of_another_robot_are_refused_and_both_are_named(root: Path, tmp_path: Path) -> None:
    calibrated = read_calibration(load_installed(root).path).robot
    assert calibrated.serial
    others = Production(tmp_path / "others", root, {"model": calibrated.model, "serial": "4711"})
    others.take(4)
    refused = call(main, "drift-check", others.folder, "--root", root, "--json")
    error = json.loads(refused.stdout)["error"]
    assert error["code"] == "views-of-another-cell"
    assert error["values"]["differs"] == "robot"
    assert error["values"]["found"] == "4711"
    assert error["values"]["calibrated"] == calibrated.serial
    assert load_installed(root).validity.state is ValidityState.VALID
