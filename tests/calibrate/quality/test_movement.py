"""Watching a tag: planted moves are noticed and named, a sound cell is quiet, what is open stays open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.watch import Cell, Happening, simulate
from calibrate.geometry import Array, perturb, transform_points
from calibrate.projection import project_pixels
from calibrate.quality.movement.evidence import Moved
from calibrate.quality.movement.monitor import (
    LARGEST_MISFIT_PX,
    MISSED_AFTER,
    NAMED_AFTER,
    EventKind,
    MovementEvent,
    MovementMonitor,
)
from calibrate.quality.movement.pictures import (
    UNITS,
    ArmErrors,
    CellModel,
    Picture,
    deviations,
)
from calibrate.quality.movement.window import KEPT, LEARNING, RunningSums
from calibrate.views import board_in_camera
from recordings.schema.messages import Mount

MOUNTS: tuple[Mount, Mount] = ("eye-in-hand", "eye-to-hand")
BEFORE = 600
"""Pictures before anything happens in the benchmark's cells."""


def watched(cell: Cell, count: int, what: Happening | None) -> tuple[MovementMonitor, list[MovementEvent]]:
    model, pictures = simulate(cell, count, what)
    monitor = MovementMonitor(model)
    return monitor, list(monitor.add(pictures))


def kinds(events: list[MovementEvent]) -> list[EventKind]:
    return [event.kind for event in events]


def after(events: list[MovementEvent], kind: EventKind) -> int:
    return next(event.pictures for event in events if event.kind is kind) - BEFORE


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("repeated", [True, False])
def test_a_camera_knocked_by_1_mm_and_a_tenth_of_a_degree_is_noticed_and_named(
    mount: Mount, repeated: bool
) -> None:
    monitor, events = watched(Cell(1, mount, repeated), BEFORE + 60, Happening("camera", 1.0, 0.1))
    assert 1 <= after(events, EventKind.ALARM) <= 15
    named = events[-1]
    assert named.kind is EventKind.NAMED and monitor.finished
    assert named.moved is (Moved.CAMERA if mount == "eye-in-hand" else Moved.CAMERA_BASE)
    assert named.values["moved_mm"] == pytest.approx(1.0, abs=0.4)
    assert after(events, EventKind.NAMED) == after(events, EventKind.ALARM) + NAMED_AFTER


@pytest.mark.parametrize(
    ("part", "moved"), [("tag", Moved.TAG_GRIPPER), ("joint-2", Moved.JOINT_2), ("joint-4", Moved.JOINT_4)]
)
def test_what_moved_is_not_always_the_camera(part: str, moved: Moved) -> None:
    mm = 1.0 if part == "tag" else 0.0
    _, events = watched(Cell(2, "eye-to-hand", True), BEFORE + 60, Happening(part, mm, 0.1))
    assert events[-1].moved is moved


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("repeated", [True, False])
def test_a_sound_cell_that_warms_and_creeps_is_quiet(mount: Mount, repeated: bool) -> None:
    monitor, events = watched(Cell(3, mount, repeated), 600, None)
    assert set(kinds(events)) == {EventKind.LEARNED, EventKind.TESTING} and not monitor.alarmed


def test_nothing_is_named_from_two_postures() -> None:
    model, pictures = simulate(Cell(4, "eye-in-hand", True), BEFORE + 120, Happening("camera", 1.0, 0.1))
    postures = sorted({tuple(p.joints_rad) for p in pictures if p.joints_rad is not None})[:2]
    monitor = MovementMonitor(model)
    events = list(
        monitor.add(p for p in pictures if p.joints_rad is not None and tuple(p.joints_rad) in postures)
    )
    assert EventKind.ALARM in kinds(events)
    if monitor.finished:
        assert events[-1].moved is Moved.CANNOT_TELL


def test_noisy_pictures_are_no_move() -> None:
    _, events = watched(Cell(5, "eye-in-hand", True), BEFORE + 60, Happening("noise", 4.0))
    assert EventKind.PICTURES_WORSE in kinds(events) and EventKind.ALARM not in kinds(events)


def test_nothing_is_said_while_it_learns() -> None:
    model, pictures = simulate(Cell(6, "eye-in-hand", False), 80, None)
    monitor = MovementMonitor(model)
    assert list(monitor.add(pictures[: LEARNING - 1])) == [] and monitor.needed == 1
    assert kinds(list(monitor.add(pictures[LEARNING - 1 :]))) == [EventKind.LEARNED, EventKind.TESTING]


def test_postures_that_came_too_seldom_are_not_tested() -> None:
    """Twenty postures, four times each: too seldom for a history, too few for the others' test."""
    model, pictures = simulate(Cell(7, "eye-in-hand", False), 20, None)
    monitor = MovementMonitor(model)
    events = list(monitor.add([p for _ in range(3) for p in pictures][:59]))
    assert events == [] and monitor.needed == 1


def test_a_tag_that_is_not_fixed_is_refused() -> None:
    model, pictures = simulate(Cell(8, "eye-in-hand", False), LEARNING, None)
    rng = np.random.default_rng(1)
    moved = [replace(p, pixels=p.pixels + rng.normal(size=2) * 60) for p in pictures]
    monitor = MovementMonitor(model)
    (event,) = monitor.add(moved)
    assert event.kind is EventKind.NOT_FIXED and monitor.finished
    assert float(str(event.values["median_misfit_px"])) > LARGEST_MISFIT_PX


def test_pictures_without_the_tag_are_told() -> None:
    model, _ = simulate(Cell(8, "eye-in-hand", True), 10, None)
    monitor = MovementMonitor(model)
    told = [event for k in range(2 * MISSED_AFTER) for event in monitor.miss(str(k))]
    assert [event.values["in_a_row"] for event in told] == [MISSED_AFTER, 2 * MISSED_AFTER]


def test_one_at_a_time_or_all_at_once_is_the_same() -> None:
    model, pictures = simulate(Cell(9, "eye-to-hand", True), BEFORE + 60, Happening("camera", 1.0))
    pictures = pictures[430:]
    together, single = MovementMonitor(model), MovementMonitor(model)
    assert list(together.add(pictures)) == [event for p in pictures for event in single.add([p])]


@pytest.mark.parametrize("repeated", [True, False])
def test_creep_that_began_with_the_learning_is_not_learned_away(
    repeated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 0.2 mm a day every window lies within the dead band of what was before it."""
    cell = Cell(11, "eye-in-hand", repeated, creep_mm=0.2)
    monkeypatch.setattr("calibrate.quality.movement.monitor.SHIFT_M", 0.25e-3)
    model, pictures = simulate(cell, 3000, None)
    monitor = MovementMonitor(model)
    events = list(monitor.add(pictures))
    (alarm,) = (event for event in events if event.kind is EventKind.ALARM)
    assert alarm.values["crept"] is True and 0.25 < alarm.pictures / 1000 * cell.creep_mm < 0.6
    assert events[-1].kind is EventKind.NAMED and events[-1].moved in (Moved.CAMERA, Moved.CANNOT_TELL)


def test_a_cell_without_blurred_pictures_needs_fewer_of_a_knock() -> None:
    model, pictures = simulate(Cell(12, "eye-in-hand", True), BEFORE + 20, Happening("camera", 3.0))
    needed = []
    for far in (None, 0.0):
        monitor = MovementMonitor(model)
        list(monitor.add(pictures[:BEFORE]))
        assert monitor.repeated is not None
        if far is not None:
            monitor.repeated._usual[0] = far
        needed.append(next(iter(monitor.add(pictures[BEFORE:]))).pictures - BEFORE)
    assert needed[1] < needed[0]


@pytest.mark.parametrize("mount", MOUNTS)
def test_effects_are_the_derivatives_of_the_picture(mount: Mount) -> None:
    """What small moves of X, P and a joint do to the corners, against the effects, by projecting anew."""
    model, pictures = simulate(Cell(10, mount, False), 3, None)
    rng = np.random.default_rng(2)
    P = perturb(np.eye(4), rng.normal(size=6) * 0.1)
    P[:3, 3] += [0.1, 0.0, 0.6] if mount == "eye-in-hand" else [0.0, 0.0, 0.1]

    def seen(cell: CellModel, tag: Array) -> list[Picture]:
        C = board_in_camera(cell.mount, np.array([p.base_from_flange for p in pictures]), cell.X, tag)
        points = np.array([p.points for p in pictures])
        pixels = project_pixels(cell.camera, transform_points(C, points))
        return [replace(p, pixels=pixels[k]) for k, p in enumerate(pictures)]

    for column in range(12):
        step = np.zeros(6)
        step[column % 6] = 0.1 * UNITS[column]
        X, tag = (perturb(model.X, step), P) if column < 6 else (model.X, perturb(P, step))
        for whitened in deviations(model, P, seen(replace(model, X=X), tag), ArmErrors()):
            wanted = 0.1 * whitened.effects[..., column]
            np.testing.assert_allclose(whitened.y, wanted, atol=2e-3 * np.abs(wanted).max())


def test_running_sums_forget_what_is_old() -> None:
    sums = RunningSums((2,))
    rng = np.random.default_rng(3)
    values = rng.normal(size=(5 * KEPT + 7, 2))
    for value in values:
        sums.append(value)
    np.testing.assert_allclose(sums.latest(np.array([3, 384])), [values[-3:].sum(0), values[-384:].sum(0)])
    np.testing.assert_allclose(sums.before(384), values[-KEPT:-384].sum(axis=0), atol=1e-9)
    assert len(sums) == KEPT
