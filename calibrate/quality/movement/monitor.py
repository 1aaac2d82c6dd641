"""Movement monitor: images in, events out (learning, testing, alarm, cause)."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from scipy import special

from calibrate.errors import BadViewsError
from calibrate.geometry import Array, inverse, project_to_rotation, rotation_log
from calibrate.lens.pnp import candidate_poses
from calibrate.quality.drift import SHIFT_M, TURN_RAD
from calibrate.quality.movement.comparisons import (
    FIRST_VISITS,
    FreePostures,
    PostureIndex,
    RepeatedPostures,
    Row,
)
from calibrate.quality.movement.evidence import Moved, has_crept, move_size, what_moved
from calibrate.quality.movement.pictures import (
    ArmErrors,
    CellModel,
    Deviations,
    Picture,
    all_deviations,
    deviations,
    fitted_tag,
    same_corners,
)
from calibrate.quality.movement.window import CREEP_WINDOW, KEPT, LEARNING, WindowFinding
from calibrate.views import BoardView
from recordings.errors import Value

NAMED_AFTER = 30
"""Images after an alarm at which the cause is named."""
MISSED_AFTER = 50
"""Images in a row without the tag at which it is reported missing."""
LARGEST_MISFIT_PX = 20.0
"""Median deviation of the learning images above which the tag is not fixed, or X is another one."""
_JUDGED_FOR = 20
"""Images over which a finding of the fast test is judged: a move, or only worse images."""
_CHANCE = 0.999
"""Quantile of the share that noise alone would explain, which a move must exceed."""
_FEWEST_POSTURES, _LEAST_TURN_RAD = 3, float(np.radians(5.0))
"""Fewest postures, and smallest turn (1σ) about the second axis, from which a cause is named."""
_STARTS = 8
_FACTORS = (0.25, 0.5, 1.0, 2.0)
"""Factors on the usual size of an arm's errors that are tried."""
Test = RepeatedPostures | FreePostures


class EventKind(StrEnum):
    """Kind of an event of the monitor."""

    LEARNED = "learned"
    NOT_FIXED = "not-fixed"
    """The learning images do not agree with one pose of the tag: nothing can be monitored."""
    TESTING = "testing"
    """The test for this kind of images has begun."""
    ALARM = "alarm"
    NAMED = "named"
    PICTURES_WORSE = "pictures-worse"
    TAG_UNSEEN = "tag-unseen"


@dataclass(frozen=True)
class MovementEvent:
    kind: EventKind
    picture: str
    """Name of the image that caused the event."""
    pictures: int
    """Number of images with the tag so far."""
    moved: Moved | None = None
    values: dict[str, Value] = field(default_factory=dict)
    """Figures; each name ends in its unit."""


@dataclass
class _Suspicion:
    """An alarm whose cause is still to be named."""

    test: Test
    since: int
    """Images of that test since the move."""
    after: int = 0


class MovementMonitor:
    """Watches one tag in one cell; `add` pictures as they come.

    The first `LEARNING` images give the tag's pose and the noise. Memory is bounded. Once `finished` (after
    NAMED or NOT_FIXED) nothing more is tested.
    """

    def __init__(self, cell: CellModel, P: Array | None = None) -> None:
        """P: (4, 4) the tag's pose where it is known; None: from the first images."""
        self.cell = cell
        self.pictures = 0
        self.missed = 0
        self.P = P
        """(4, 4) base_from_tag (eye-in-hand) or flange_from_tag, once it is learned."""
        self.repeated: RepeatedPostures | None = None
        self.free: FreePostures | None = None
        self.learned = 0
        """Number of images before the latest test began."""
        self.alarmed = self.finished = False
        self._learning: list[Picture] = []
        self._index = PostureIndex()
        self._first: dict[int, list[Picture]] = {}
        """First visits of each posture that may repeat."""
        self._visits: list[tuple[int, Picture]] = []
        """Visits of repeated postures until their test begins."""
        self._others: list[Picture] = []
        """Images of other postures until their test begins."""
        self._arm = ArmErrors()
        self._turns: dict[bool, deque[tuple[int, Array]]] = {
            kind: deque(maxlen=KEPT) for kind in (False, True)
        }
        self._suspicion: _Suspicion | None = None

    @property
    def needed(self) -> int:
        """Images still needed before anything is tested; 0 once a test runs."""
        if self.repeated is not None or self.free is not None:
            return 0
        return LEARNING - max(len(self._learning), len(self._visits), len(self._others))

    def forget(self) -> None:
        """Forget all images but the learning ones, because images are missing from here on."""
        for test in (self.repeated, self.free):
            if test is not None:
                test.forget()

    def miss(self, name: str) -> Iterator[MovementEvent]:
        """Take note of a picture without the tag."""
        self.missed += 1
        if self.missed % MISSED_AFTER == 0:
            yield self._event(EventKind.TAG_UNSEEN, name, in_a_row=self.missed)

    def add(self, pictures: Iterable[Picture]) -> Iterator[MovementEvent]:
        """Judge images with the tag, oldest first. Many at once are faster and give the same events."""
        waiting = list(pictures)
        if self.P is None and not self.finished:
            taken = LEARNING - len(self._learning)
            self._learning += waiting[:taken]
            self.pictures += len(waiting[:taken])
            if len(self._learning) < LEARNING:
                return
            yield self._place_tag()
            self.pictures -= LEARNING
            waiting, self._learning = [*self._learning, *waiting[taken:]], []
        if self.P is None:
            return
        for group in same_corners(waiting):
            while group and not self.finished:
                group = yield from self._add_alike(group)

    def _add_alike(self, group: list[Picture]) -> Generator[MovementEvent, None, list[Picture]]:
        """Judge images with equally many corners; return those left over when a test begins."""
        assert self.P is not None
        arm = self._arm
        again, anywhere = deviations(self.cell, self.P, group, arm)
        for place, picture in enumerate(group):
            if self.finished or self._arm != arm:
                return group[place:]
            self.pictures, self.missed = self.pictures + 1, 0
            yield from self._step(picture, again.y[place], (anywhere.effects[place], anywhere.y[place]))
        return []

    def _place_tag(self) -> MovementEvent:
        P, misfit_px = fitted_tag(self.cell, self._learning, self._tag_starts())
        kind = EventKind.LEARNED if misfit_px <= LARGEST_MISFIT_PX else EventKind.NOT_FIXED
        self.finished = kind is EventKind.NOT_FIXED
        self.P = None if self.finished else P
        return self._event(kind, self._learning[-1].name, median_misfit_px=round(misfit_px, 3))

    def _tag_starts(self) -> list[Array]:
        """List poses (4, 4) of the tag by single images, both solutions where the tilt is ambiguous."""
        starts = []
        for picture in self._learning[:: max(1, len(self._learning) // _STARTS)]:
            F, X = picture.base_from_flange, self.cell.X
            view = BoardView(0, picture.name, F, picture.points, picture.pixels)
            camera = F @ X if self.cell.mount == "eye-in-hand" else inverse(F) @ X
            try:
                starts += [
                    camera @ c.camera_from_board for c in candidate_poses(view, self.cell.camera, None)
                ]
            except BadViewsError:
                continue
        return starts or [np.eye(4)]

    def _step(self, picture: Picture, again: Array, anywhere: Row) -> Iterator[MovementEvent]:
        slot, known = self._index.find(picture)
        turn = (slot, picture.base_from_flange[:3, :3])
        if slot in self._first or not known:
            yield from self._step_free(picture, turn, anywhere)
            yield from self._first_visit(picture, slot, known)
            return
        self._turns[True].append(turn)
        if self.repeated is None:
            self._visits.append((slot, picture))
            yield from self._begin_repeated(picture)
        else:
            yield from self._judge(picture, self.repeated, self.repeated.add((slot, again)))

    def _first_visit(self, picture: Picture, slot: int, known: bool) -> Iterator[MovementEvent]:
        """Collect the first visits of a posture until it counts as repeated."""
        visits = self._first[slot] = [*(self._first[slot] if known else ()), picture]
        if len(visits) < FIRST_VISITS or (number := self._index.keep(slot)) is None:
            del visits[: -FIRST_VISITS + 1]
            return
        del self._first[slot]
        if self.repeated is not None:
            self.repeated.establish(self._whitened(visits, self._arm)[0])
            return
        self._visits += [(number, visit) for visit in visits]
        yield from self._begin_repeated(picture)

    def _whitened(self, pictures: list[Picture], arm: ArmErrors) -> tuple[Deviations, Deviations]:
        assert self.P is not None
        return all_deviations(self.cell, self.P, pictures, arm)

    def _begin_repeated(self, picture: Picture) -> Iterator[MovementEvent]:
        """Begin the test of repeated postures with the most likely repeatability of the arm."""
        if len(self._visits) < LEARNING:
            return
        postures, visits = [number for number, _ in self._visits], [visit for _, visit in self._visits]
        tests = {
            factor: RepeatedPostures(postures, self._whitened(visits, ArmErrors(repeating=factor))[0])
            for factor in _FACTORS
        }
        best = max(tests, key=lambda factor: tests[factor].log_likelihood)
        self._arm, self.repeated, self._visits = replace(self._arm, repeating=best), tests[best], []
        yield self._testing(picture, self.repeated)

    def _step_free(self, picture: Picture, turn: tuple[int, Array], row: Row) -> Iterator[MovementEvent]:
        self._turns[False].append(turn)
        if self.free is not None:
            yield from self._judge(picture, self.free, self.free.add(row))
            return
        self._others.append(picture)
        if len(self._others) < LEARNING:
            return
        covariance, others = self.cell.X_covariance, self._others
        tests = {
            factor: FreePostures(covariance, self._whitened(others, replace(self._arm, table=factor))[1])
            for factor in _FACTORS
        }
        best = max(tests, key=lambda factor: tests[factor].log_likelihood)
        self._arm, self.free, self._others = replace(self._arm, table=best), tests[best], []
        yield self._testing(picture, self.free)

    def _testing(self, picture: Picture, test: Test) -> MovementEvent:
        kind, self.learned = "repeated" if test is self.repeated else "any", self.pictures
        return self._event(EventKind.TESTING, picture.name, postures=kind, noise=round(test.noise, 3))

    def _judge(self, picture: Picture, test: Test, finding: WindowFinding) -> Iterator[MovementEvent]:
        if self._suspicion is not None:
            yield from self._name(picture, test, self._suspicion)
        elif finding.alarm:
            yield self._alarm(picture, test, finding.window, finding)
        elif (crept := test.creep()) is not None and has_crept(*crept, (SHIFT_M, TURN_RAD)):
            yield from self._creep(picture, test)
        elif 0 < finding.far <= _JUDGED_FOR:
            share, count = test.explained_share(finding.far)
            if share > self._share_of_noise(count):
                yield self._alarm(picture, test, finding.far, finding)
            elif finding.far == _JUDGED_FOR:
                yield self._event(EventKind.PICTURES_WORSE, picture.name)

    def _event(self, kind: EventKind, picture: str, **values: Value) -> MovementEvent:
        return MovementEvent(kind, picture, self.pictures, None, values)

    def _share_of_noise(self, count: int) -> float:
        """Share of the noise of n images that p unknowns rarely explain by chance: Beta(p/2, (6 n - p)/2)."""
        moves = 12 if self.cell.arm is None else 16
        return float(special.betaincinv(moves / 2, (6 * count - moves) / 2, _CHANCE))

    def _alarm(self, picture: Picture, test: Test, since: int, finding: WindowFinding) -> MovementEvent:
        self.alarmed, self._suspicion = True, _Suspicion(test, since)
        return self._event(
            EventKind.ALARM,
            picture.name,
            log_ratio=round(finding.score, 2),
            limit=test.limit,
            since_pictures=since,
            fast_lane=not finding.alarm,
        )

    def _creep(self, picture: Picture, test: Test) -> Iterator[MovementEvent]:
        """Report a slow move since the learning, and its cause."""
        self.alarmed = True
        yield self._event(EventKind.ALARM, picture.name, crept=True, since_pictures=self.pictures)
        yield self._named(picture, test, CREEP_WINDOW, learned=True)

    def _name(self, picture: Picture, test: Test, suspicion: _Suspicion) -> Iterator[MovementEvent]:
        """Name the cause, `NAMED_AFTER` images of the test after its alarm."""
        if test is not suspicion.test:
            return
        suspicion.after += 1
        if suspicion.after == NAMED_AFTER:
            yield self._named(picture, test, suspicion.since + suspicion.after)

    def _named(self, picture: Picture, test: Test, count: int, learned: bool = False) -> MovementEvent:
        self.finished = True
        M, u = test.move_since(count, learned)
        moved, log_odds = what_moved(M, u, self.cell.mount)
        postures, turn_rad = self._variety(test, count)
        if postures < _FEWEST_POSTURES or turn_rad < _LEAST_TURN_RAD:
            moved = Moved.CANNOT_TELL
        values: dict[str, Value] = {
            "log_odds": round(log_odds, 2),
            "postures": postures,
            "turn_deg": round(float(np.degrees(turn_rad)), 2),
        }
        if moved in (Moved.CAMERA, Moved.CAMERA_BASE, Moved.TAG, Moved.TAG_GRIPPER):
            size, _ = move_size(M, u, moved)
            values["moved_mm"] = round(float(np.linalg.norm(size[:3]) * 1e3), 3)
            values["moved_deg"] = round(float(np.degrees(np.linalg.norm(size[3:]))), 4)
        return MovementEvent(EventKind.NAMED, picture.name, self.pictures, moved, values)

    def _variety(self, test: Test, count: int) -> tuple[int, float]:
        """Count the postures of the latest images; compute 1σ of their turns about the second axis, rad."""
        turns = list(self._turns[test is self.repeated])[-count:]
        R = np.array([turn for _, turn in turns])
        apart = rotation_log(R @ project_to_rotation(R.mean(axis=0)).T)
        spread = np.linalg.eigvalsh(np.cov(apart.T))
        return len({slot for slot, _ in turns}), float(np.sqrt(max(spread[1], 0.0)))
