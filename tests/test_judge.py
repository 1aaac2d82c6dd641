"""The judge apart (`benchmarks/judge`): what its generator says is true, by what is known without it."""

from __future__ import annotations

import ast
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from benchmarks.judge.arms import ARMS, Chain, flange_error_mm, sample, solve_joints
from benchmarks.judge.cell import MOUNTS, Cell, Name, board_points, make, make_of
from benchmarks.judge.frames import apply, inverse, pose, rotation, rotation_vector
from benchmarks.judge.kinds import EVERY, KINDS, UNSEEN, Kind, drawn
from benchmarks.judge.lenses import LENSES, LensModel
from benchmarks.judge.placed_point import errors, recorded_postures, told_camera, workspace_postures
from benchmarks.judge.rows import Row, line, names, read
from benchmarks.judge.run import run
from benchmarks.judge.tables import interval, tables

JUDGE = Path(__file__).parents[1] / "benchmarks" / "judge"
AT = np.array([0.0, 0.0, 0.5])


def perfect(arm: str, mount: str, kind: Kind | None = None) -> Cell:
    """A cell whose arm is its table."""
    whose = Name("perfect", arm, mount, True, 0, 0)
    return make_of(whose, kind or Kind("perfect", links=0.0), replace(ARMS[arm], repeat_rad=0.0))


def with_links(cell: Cell, place: int, motion: np.ndarray) -> Cell:
    """The same cell with a real arm whose link at `place` is moved by `motion` (4, 4) in its own frame."""
    links = cell.world.real.links.copy()
    links[place] = links[place] @ motion
    return replace(cell, world=replace(cell.world, real=Chain(links)))


def test_the_generator_imports_nothing_of_what_it_judges() -> None:
    allowed = {"numpy", "scipy", "cv2", *sys.stdlib_module_names}
    for path in JUDGE.glob("*.py"):
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                found.add(node.module or "")
        others = {name for name in found if name.partition(".")[0] not in allowed}
        others = {name for name in others if not name.startswith("benchmarks.judge")}
        if path.stem == "solver":
            assert others, "the adapter is the door to the product"
            others = {name for name in others if name.partition(".")[0] not in {"calibrate", "recordings"}}
        assert not others, f"{path.name} imports {others}"


@given(st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3))
def test_rotations_are_scipys(vector: list[float]) -> None:
    R = rotation(vector)
    assert np.allclose(R, Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    assert np.allclose(rotation_vector(R), vector, atol=1e-9)


def test_an_inverse_pose_undoes_the_pose() -> None:
    T = pose(rotation([[0.3, -1.0, 0.5], [0.0, 0.0, 0.0]]), [[1.0, 2.0, 3.0], [0.0, 0.0, 1.0]])
    assert np.allclose(inverse(T) @ T, np.eye(4))
    assert np.allclose(apply(inverse(T), apply(T, [[1.0, 0.0, 2.0]] * 2)), [1.0, 0.0, 2.0])


@pytest.mark.parametrize("model", LENSES)
def test_projection_is_opencvs(model: LensModel) -> None:
    lens = LENSES[model]
    K = np.array(
        [[lens.focal_px[0], 0, lens.centre_px[0]], [0, lens.focal_px[1], lens.centre_px[1]], [0, 0, 1]]
    )
    points = np.random.default_rng(1).uniform([-0.2, -0.15, 0.4], [0.2, 0.15, 0.8], (50, 3))
    zero = np.zeros(3)
    if model == "equidistant":
        known, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, K, np.array(lens.distortion))
    else:
        known, _ = cv2.projectPoints(points, zero, zero, K, np.array(lens.distortion))
    assert np.allclose(lens.project(points), known[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("arm", "at", "ahead"),
    [
        # Universal Robots' table: x = a2 + a3, y = -(d4 + d6), z = d1 - d5
        ("UR", [-1.1843, -0.256141, 0.0116], [0.0, -1.0, 0.0]),
        # ABB's drawing: 150 + 600 + 65 before, 486.5 + 700 up
        ("industrial six", [0.815, 0.0, 1.1865], [1.0, 0.0, 0.0]),
        # Franka's drawing: 88 before, 333 + 316 + 384 - 107 up
        ("seven joints", [0.088, 0.0, 0.926], [0.0, 0.0, -1.0]),
        ("servo arm", [0.36575, 0.0, 0.36065], [1.0, 0.0, 0.0]),
    ],
)
def test_arms_at_zero_are_as_their_makers_draw_them(arm: str, at: list[float], ahead: list[float]) -> None:
    chain = ARMS[arm].chain
    flange = chain.flange(np.zeros(chain.joints))
    assert np.allclose(flange[:3, 3], at, atol=1e-9)
    assert np.allclose(flange[:3, 2], ahead, atol=1e-9)


@pytest.mark.parametrize("arm", ARMS)
def test_each_joint_turns_the_flange_about_its_own_axis(arm: str) -> None:
    chain = ARMS[arm].chain
    q = np.array(ARMS[arm].home)
    frames = chain.axes(q)
    for i in range(chain.joints):
        turned = q.copy()
        turned[i] += 0.4
        axis = frames[i, :3, 2]
        R = Rotation.from_rotvec(0.4 * axis).as_matrix()
        about = frames[i, :3, 3]
        moved = pose(R, about - R @ about) @ frames[-1]
        assert np.allclose(chain.flange(turned), moved, atol=1e-9)


@pytest.mark.parametrize("arm", ARMS)
def test_joints_found_for_a_flange_lead_to_it(arm: str) -> None:
    rng = np.random.default_rng(2)
    home = np.array(ARMS[arm].home)
    goal = ARMS[arm].chain.flange(home + 0.2 * rng.normal(size=(20, len(home))))
    q, reached = solve_joints(ARMS[arm], goal, home)
    assert reached.mean() > 0.6
    assert np.allclose(ARMS[arm].chain.flange(q[reached]), goal[reached], atol=1e-6)


@pytest.mark.parametrize("arm", ARMS)
def test_real_arms_are_as_far_off_as_published_for_their_class(arm: str) -> None:
    rng = np.random.default_rng(0)
    home = np.array(ARMS[arm].home)
    low = home - 1.0
    high = home + 1.0
    low[0] = -np.pi
    high[0] = np.pi
    q = sample(ARMS[arm], rng, 300, low, high)
    registered_mm = [flange_error_mm(ARMS[arm], ARMS[arm].real(rng), q)[1] for _ in range(300)]
    rms_mm = np.sqrt(np.mean(np.square(registered_mm)))
    assert 0.88 < rms_mm / ARMS[arm].published_mm < 1.12


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("arm", ARMS)
def test_a_perfect_arm_with_the_real_camera_places_every_point(arm: str, mount: str) -> None:
    cell = perfect(arm, mount)
    rng = np.random.default_rng(3)
    assert np.abs(errors(cell, cell.X, AT, recorded_postures(cell, rng), rng)).max() < 1e-12
    over_all = workspace_postures(cell, AT, rng)
    assert len(over_all.tool) > 100
    assert np.abs(errors(cell, cell.X, AT, over_all, rng)).max() < 1e-12
    assert np.allclose(told_camera(cell), cell.X, atol=1e-9)


@pytest.mark.parametrize("arm", ARMS)
def test_a_base_that_is_off_moves_points_of_a_fixed_camera_alone(arm: str) -> None:
    off = np.array([1e-3, -2e-3, 5e-4])
    for mount in MOUNTS:
        cell = perfect(arm, mount)
        shifted = with_links(cell, 0, pose(np.eye(3), off))
        moved = pose(np.eye(3), cell.world.real.links[0, :3, :3] @ off)
        rng = np.random.default_rng(4)
        e = errors(shifted, cell.X, AT, recorded_postures(cell, rng), rng)
        expected = np.zeros(3) if mount == "eye-in-hand" else moved[:3, 3]
        assert np.allclose(e, expected, atol=1e-12)


@pytest.mark.parametrize("arm", ARMS)
def test_a_flange_that_is_off_errs_by_the_turn_between_both_postures(arm: str) -> None:
    off = np.array([1e-3, -2e-3, 5e-4])
    for mount in MOUNTS:
        cell = with_links(perfect(arm, mount), -1, pose(np.eye(3), off))
        rng = np.random.default_rng(5)
        pairs = recorded_postures(cell, rng)
        a = ARMS[arm].chain.flange(pairs.picture)[:, :3, :3] @ off
        b = ARMS[arm].chain.flange(pairs.tool)[:, :3, :3] @ off
        e = errors(cell, cell.X, AT, pairs, rng)
        assert np.allclose(e, b - a if mount == "eye-in-hand" else b, atol=1e-12)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_camera_that_is_off_misses_by_its_own_shift(mount: str) -> None:
    cell = perfect("UR", mount)
    off = np.array([0.0, 3e-3, 0.0])
    X = cell.X @ pose(np.eye(3), off)
    rng = np.random.default_rng(6)
    e = errors(cell, X, AT, recorded_postures(cell, rng), rng)
    assert np.allclose(np.linalg.norm(e, axis=1), 3e-3)


@pytest.mark.parametrize("mount", MOUNTS)
def test_what_was_recorded_shows_the_board_where_the_truth_has_it(mount: str) -> None:
    cell = perfect("industrial six", mount)
    lens = cell.lens
    K = np.array(
        [[lens.focal_px[0], 0, lens.centre_px[0]], [0, lens.focal_px[1], lens.centre_px[1]], [0, 0, 1]]
    )
    for view in cell.views:
        held = view.flange
        C = inverse(held @ cell.X) @ cell.world.Y
        if mount == "eye-to-hand":
            C = inverse(cell.X) @ held @ cell.world.Y
        shown, _ = cv2.projectPoints(
            view.points, rotation_vector(C[:3, :3]), C[:3, 3], K, np.array(lens.distortion)
        )
        assert np.abs(shown[:, 0] - view.pixels).max() < 1.0
        assert np.allclose(ARMS["industrial six"].chain.flange(view.joints), view.flange)


@pytest.mark.parametrize("kind", EVERY)
def test_every_kind_makes_a_cell_that_differs_from_a_clean_one(kind: str) -> None:
    cell = make(Name(kind, "UR", "eye-in-hand", True, 0, 0))
    again = make(Name(kind, "UR", "eye-in-hand", False, 0, 0, told=False))
    assert len(cell.views) == EVERY[kind].views
    for view, same in zip(cell.views, again.views, strict=True):
        assert np.array_equal(view.pixels, same.pixels), "the same recording whatever is told of it"
    other = make(Name(kind, "UR", "eye-in-hand", True, 1, 0))
    assert len(other.views) != len(cell.views) or not np.array_equal(other.told, cell.told)
    plain = replace(EVERY[kind], **{k: v for k, v in vars(Kind("")).items() if k not in {"name"}})
    assert kind == "clean" or plain != EVERY[kind]


def test_another_draw_has_other_sizes_between_a_half_and_twice() -> None:
    assert len(UNSEEN) == 5
    for kind in (*KINDS, *UNSEEN):
        assert drawn(kind, 0) == kind
        assert drawn(kind, 7) == drawn(kind, 7)
        if kind.name != "clean":
            assert any(drawn(kind, draw) != kind for draw in range(1, 6)), f"{kind.name} has no other size"
        for name in ("sag", "backlash", "eccentric", "creep", "bump_mm", "told_mm", "bend_mm", "growth"):
            size = getattr(kind, name)
            other = getattr(drawn(kind, 7), name)
            assert (other == 0.0) == (size == 0.0)
            if size:
                assert other != size
                assert 0.5 <= other / size <= 2.0
    right = drawn(EVERY["factory lens, right"], 7)
    assert right.given_told == right.given_error, "a lens that is told rightly stays so"


def test_a_rounded_pose_is_the_pose_to_half_a_step() -> None:
    cell = make(Name("poses to 1 mm", "UR", "eye-in-hand", True, 0, 0))
    exact = ARMS["UR"].chain.flange(cell.shown)
    off = cell.told[:, :3, 3] - exact[:, :3, 3]
    assert 0.2e-3 < np.abs(off).max() <= 0.5e-3 + 1e-12
    turned = rotation_vector(cell.told[:, :3, :3] @ np.swapaxes(exact[:, :3, :3], 1, 2))
    assert 0.0 < np.linalg.norm(turned, axis=1).max() < np.radians(0.1)


def test_a_bump_leaves_two_cameras_and_the_second_is_the_true_one() -> None:
    cell = perfect("UR", "eye-in-hand", Kind("perfect", links=0.0, bump_mm=2.0))
    X = inverse(cell.told) @ cell.world.Y @ inverse(cell.seen)
    shift_mm = 1e3 * np.linalg.norm(X[:, :3, 3] - cell.X[:3, 3], axis=1)
    assert np.allclose(shift_mm[:10], 2.0)
    assert np.allclose(shift_mm[10:], 0.0, atol=1e-9)


def test_half_of_the_pictures_show_a_part_of_an_occluded_board() -> None:
    cell = make(Name("occlusion", "UR", "eye-in-hand", True, 0, 0))
    counts = [len(view.pixels) for view in cell.views]
    whole = len(board_points(0.025))
    assert sum(count == whole for count in counts) == 10
    assert min(counts) >= 12


def test_any_number_of_cells_covers_the_kinds_evenly_and_none_twice() -> None:
    wanted = list(names(list(EVERY), [0, 1], 32 * 40))
    assert len(set(wanted)) == len(wanted)
    for kind in EVERY:
        assert sum(name.kind == kind for name in wanted) == 40
    pools = [(name.mount, name.joints) for name in wanted]
    assert {pools.count(pool) for pool in set(pools)} == {320}


def test_an_interval_is_the_exact_one() -> None:
    for count, of in ((0, 20), (3, 20), (20, 20)):
        known = binomtest(count, of).proportion_ci(0.95)
        assert np.allclose(interval(count, of), (known.low, known.high))


def test_tables_tell_ratios_of_each_cell_and_who_was_refused() -> None:
    good = Row(
        "clean", "UR", "eye-in-hand", True, 0, 0, passed=True, stated=1.0, stated_workspace=2.0, rms=0.9,
        median=0.8, beyond=0.0, one=0.7, rms_workspace=5.0, median_workspace=1.0, beyond_workspace=0.1,
        one_workspace=7.0, square=5.0, square_installed=40.0, square_told=6.0, threshold=12.6, price=0.5,
        cpu_s=0.3,
    )  # fmt: skip
    refused = Row("bump", "UR", "eye-in-hand", True, 0, 0, refused="camera-moved", named="camera-moved")
    text = tables([good, refused])
    lines = [[cell.strip() for cell in text_line.split("|")[1:-1]] for text_line in text.splitlines()]
    points = next(cells for cells in lines if cells[:1] == ["in hand, joints"])
    assert points[1:8] == ["1 of 2", "0.90", "0.80", "0", "2.50", "0.50", "100"]
    passes = [cells for cells in lines if cells[:1] == ["in hand, joints"]][2]
    assert passes[1] == "1"
    assert passes[2] == "0 of 1"
    assert passes[5] == "1 of 1"
    price = [cells for cells in lines if cells[:1] == ["in hand, joints"]][3]
    assert price[2] == "2.00"
    assert ["bump", "1", "0", "100", "camera-moved 1"] in lines


def test_tables_tell_the_parts_and_the_stated_distance_where_the_solver_states_them() -> None:
    parts = {"from_x": 0.2, "from_arm": 0.5, "floor": 0.1}
    row = Row(
        "clean", "UR", "eye-to-hand", False, 0, 0, stated=0.6, stated_p95=1.1, stated_parts=parts,
        stated_arm="assumed", rms=0.5, within_p95=0.96,
    )  # fmt: skip
    lines = [[cell.strip() for cell in text.split("|")[1:-1]] for text in tables([row]).splitlines()]
    assert ["fixed, none", "1", "96.0"] in lines
    assert ["cells", "floor mm", "from_arm mm", "from_x mm", "arm"] in lines
    assert ["fixed, none", "0.1", "0.5", "0.2", "assumed 1"] in lines
    assert tables([]).startswith("0 cells")


def test_a_file_of_rows_is_read_as_it_was_written(tmp_path: Path) -> None:
    row = Row("clean", "UR", "eye-to-hand", False, 3, 1, told=False, closed=("weight",), stated=0.6)
    out = tmp_path / "rows.jsonl"
    out.write_text(line(row) + "\n")
    assert read(out) == [row]
    assert read(tmp_path / "none.jsonl") == []


@pytest.mark.process
def test_a_run_that_was_cut_short_goes_on_where_it_was(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    wanted = list(names(["6 views"], [0], 2))
    run(out, wanted, 0.0, 1)
    first, second = out.read_text().splitlines()
    out.write_text(f"{first}\n{second[:40]}")
    run(out, wanted, 0.0, 1)
    rows = read(out)
    assert {row.key for row in rows} == {read_row.key for read_row in rows}
    assert len(rows) == 2
    assert line(rows[0]) == first
    before = out.read_text()
    run(out, wanted, 0.0, 1)
    assert out.read_text() == before, "nothing is done again"
