"""Did the camera, the board or the focus change between two views? Every place is tried.

A change competes with what else makes views disagree: an arm whose errors vary smoothly with its posture, and
single views that are wrong. Both are in the evidence of either side (`linear`), with the sizes of the arm's
errors and of the change averaged out. Where joints are not known there is one more rival: an arm that changes
its configuration, an elbow or a wrist, errs differently from then on, by a step of the size of its other
errors. The ratio of the evidences, a Bayes factor, is at least 1/α in a share of at most α of the recordings
in which nothing changed (Markov's inequality): one stated probability of a false claim is the only threshold.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from calibrate.handeye.arm import LINKS, flex_motion
from calibrate.handeye.cell_state import Quadratic
from calibrate.handeye.linear import Linear, LinearSolution
from calibrate.handeye.mixture import class_chances
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.pose_fit import (
    FREE,
    BoardPoses,
    Moved,
    PoseFit,
    PoseViews,
    fit_poses,
    linearise,
    pose_prior,
)
from calibrate.handeye.priors import ARM_ERROR_UNIT
from calibrate.handeye.solution import Reading
from recordings.geometry import Array, difference

FALSE_CLAIM = 1e-3
"""Probability of a claim in a recording in which nothing changed."""
HELD = 0.95
"""Probability that the first changed view is in the range that is told."""
FEWEST_PER_PART = 2
"""Fewest views before and after a change that agree: one alone may as well be a wrong view."""
FOCAL = 1
"""Index of the focal length among the factors of `pose_views`."""
_POSE = 6
"""Numbers of a change of pose; a focal length has one."""
_BOARD_SIZE = 12
"""Index of the board's size among the unknowns, behind X and Y."""
_SIZES = np.array([0.03, 0.12, 0.48])
"""1σ of the arm's errors, mm and mrad, from what no view can tell from none."""
_CHANGE_SIZES = 1e-4 * 4.0 ** np.arange(6)
"""1σ of a change: metres, radians, or relative of a focal length."""
_SMOOTH = 8
"""Most shapes of the smooth function, those that vary most over the views."""
_SLOW = 3
"""Half waves, over the recording, of an error that changes slowly."""
_NEAREST = 24
"""Places on either side of the best one that are weighed exactly; the others were looked at in the scan."""
_MOST_PLACES = 120
"""Most places, evenly spread, that are looked at by medians."""
_MOST_FITS = 3
"""Most fits of one change, each at the place that the one before found better."""
_AGREES = 0.5
"""Probability of ordinary noise from which a view agrees."""
_ROUNDS = 20
"""Rounds of expectation and maximisation for each size of the arm's errors. After a few, evidence may be off
by tens of nats: noise shrinks slowly from that of a fit without errors by posture."""
_ROUNDS_BESIDE = 6
"""Rounds at a place, from the noise of the place beside."""


@dataclass(frozen=True)
class Change:
    """A change of one kind, wherever it was."""

    reading: Reading
    log_bayes: float
    """Log evidence over that of a recording in which nothing changed."""
    at: int
    """Index of the first changed view: the likeliest."""
    first: int
    last: int
    """Indices between which the first changed view is, with probability `HELD`."""
    factor: float = 1.0
    """Of the focal length, after the change over before."""


def is_claimed(log_bayes: float) -> bool:
    """Tell whether a change is so much likelier than none that it may be claimed."""
    return bool(log_bayes >= -np.log(FALSE_CLAIM))


def errors_by_posture(flange: Array, by_links: Array | None = None) -> Array:
    """Compute the motion (n, 6, q) of the flange, in base, by errors of the arm that vary with its posture.

    Shift and turn are linear in the flange's position and rotation, and beside that any smooth function of
    both: a Gaussian process whose length is the median distance of two postures. They may also change slowly
    in the order of the views. A bracket bends. Where the arm's kinematics are known, so are the errors by its
    links (n, 6, p).
    """
    posture, near = _posture(flange)
    square = ((posture[:, None] - posture) ** 2).sum(axis=2)
    length = max(float(np.median(square[np.triu_indices(len(square), 1)])), 1e-9)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * square / length))
    smooth = vectors[:, -_SMOOTH:] * np.sqrt(values[-_SMOOTH:].clip(0.0))
    # What the flange does not show, an elbow's swivel or warming up, changes slowly from view to view.
    waves = np.arange(1, _SLOW + 1)
    slow = np.cos(np.pi * (np.arange(len(flange)) + 0.5)[:, None] * waves / len(flange)) / waves
    terms = LINKS * np.concatenate([posture, smooth, slow], axis=1) * near[:, None]
    by_posture = np.einsum("nk,ab->nakb", terms, np.eye(6)).reshape(len(flange), 6, -1)
    parts = [by_posture, flex_motion(flange)] + ([] if by_links is None else [by_links])
    return np.concatenate(parts, axis=2)


def _posture(flange: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return position and rotation (n, 12) of the flange, and which views (n,) are not told far away."""
    middle = np.median(flange[:, :3, 3], axis=0)
    away = np.linalg.norm(flange[:, :3, 3] - middle, axis=1)
    near = away <= 5 * max(float(np.median(away)), 1e-9)  # a pose that is told metres away sets no range
    place = (flange[:, :3, 3] - middle) / max(float(np.sqrt((away[near] ** 2).mean())), 1e-9)
    turned = (flange[:, :3, :3] - flange[near, :3, :3].mean(axis=0)).reshape(len(flange), 9)
    posture = np.concatenate([place, turned], axis=1)
    posture[~near] = 0.0
    return posture, near


def _compressed(errors: Array) -> Array:
    """Return errors (n, 6, r) with r ≤ 6n that move the views as these (n, 6, q) do.

    All have the same 1σ, so that a rotation of them changes nothing (singular value decomposition).
    """
    n, _, q = errors.shape
    if q <= 6 * n:
        return errors
    U, values, _ = np.linalg.svd(errors.reshape(6 * n, q), full_matrices=False)
    return np.asarray(U * values).reshape(n, 6, -1)


@dataclass(frozen=True, eq=False)
class _State:
    """Values of the unknowns on one side of a change."""

    X: Array
    Y: Array
    factors: Array


@dataclass(frozen=True, eq=False)
class _Sides:
    """All views linearised with the values before, and with those after a change."""

    before: Linear
    after: Linear
    column: slice
    """Columns of J by which the sides differ."""
    apart: Array
    """(d,) by how much they do."""
    priors: list[Quadratic]
    """Of the unknowns that both sides share, for each size of the arm's errors."""

    def split(self, at: int) -> Linear:
        """Linearise for a change before view `at`; the last columns are the change."""
        later = np.arange(len(self.before.m)) >= at
        wide = later[:, None, None]
        J = np.where(wide, self.after.J, self.before.J)
        change = np.where(wide, self.after.J[..., self.column], 0.0)
        return Linear(
            self.before.U,
            np.where(wide, self.after.J_C, self.before.J_C),
            np.where(later[:, None], self.after.m, self.before.m),
            np.concatenate([J, change], axis=2),
        )


@dataclass(frozen=True, eq=False)
class _Weighed:
    """A change of one kind, weighed at each place near the one it was fitted for."""

    places: NDArray[np.intp]
    logs: Array
    """Log evidence at each place."""
    log_step: float
    """Log evidence, at the best place, of a step as large as the arm's other errors."""
    scales: Scales
    """Noise of the robot beside the likeliest change."""
    apart: Array
    agrees: bool
    """Enough views before and after have ordinary noise."""

    @property
    def best(self) -> int:
        return int(self.places[self.logs.argmax()])


class ChangeSearch:
    """All changes of one recording, weighed against none."""

    def __init__(
        self,
        views: PoseViews,
        errors: Array,
        as_recorded: PoseFit,
        seed: int = 0,
        joints_known: bool = False,
    ) -> None:
        """Take the errors by posture (n, 6, q), as of `errors_by_posture`, and the fit without a change.

        joints_known: the errors hold those of the arm's links, which follow its configuration.
        """
        self._views = views
        self._errors = _compressed(errors)
        self._seed = seed
        self._joints_known = joints_known
        self._fit = as_recorded
        state = _State(as_recorded.X[0], as_recorded.Y[0], as_recorded.factors)
        self._linear = self._linearised(state)
        self._priors = [self._prior(state.factors, size) for size in _SIZES]
        scales = as_recorded.solved.scales
        self._fitted: dict[tuple[Reading, int], _Weighed | None] = {}
        self._none = [self._linear.solve(prior, scales, "robot", _ROUNDS) for prior in self._priors]

    def found(self) -> list[Change]:
        """Weigh camera, board and focus; only what the evidence may favour is looked at closely."""
        if len(self._views) < 2 * FEWEST_PER_PART + 2:
            return []
        kinds = [Reading.BOARD_MOVED, Reading.CAMERA_MOVED]
        if len(self._views.boards.sigma) > FOCAL:
            kinds.append(Reading.REFOCUSED)
        found: dict[Reading, _Weighed] = {}
        for kind in kinds:
            tried = self._promising(kind, len(kinds))
            if (self._fit.full < 0.5).any():  # views may be taken for wrong ones that followed a change
                tried += self._apart(kind)
            weighed = [one for at in dict.fromkeys(tried) if (one := self._weighed(kind, at))]
            if weighed:
                found[kind] = max(weighed, key=lambda one: special.logsumexp(one.logs))
        rivals = [self._log_none([one.scales for one in found.values()])]
        if not self._joints_known:
            rivals += [one.log_step - np.log(len(self._places)) for one in found.values()]
        return [self._change(kind, one, len(kinds), max(rivals)) for kind, one in found.items()]

    def board_size(self) -> tuple[float, float]:
        """Compute true over assumed size of the board and its 1σ beside errors of the arm.

        An arm whose places are told too near to each other makes the board seem larger: the fit without such
        errors is too sure. Sizes of the errors are weighed by their evidence.
        """
        factors = self._fit.factors[0] + np.array([one.step[_BOARD_SIZE] for one in self._none])
        variances = np.array([(one.inverse.root[_BOARD_SIZE] ** 2).sum() for one in self._none])
        weights = special.softmax([one.log_evidence for one in self._none])
        factor = float(weights @ factors)
        return factor, float(np.sqrt(weights @ (variances + (factors - factor) ** 2)))

    def _promising(self, kind: Reading, kinds: int) -> list[int]:
        """Find the place that is best beside the fit without a change, where a change may win at all.

        Each place is a step along its own columns. The noise that was found without a change holds the
        change, too: the gain is that of noise which shrinks by what the change explains.
        """
        n, column = len(self._views), self._columns(kind)
        places = self._places
        J = self._linear.J
        Z = J[..., column]
        best_at = 0
        best = 0.0
        for solved in self._none:
            WZ = solved.W @ Z
            shared = _later(np.swapaxes(J, 1, 2) @ WZ)[places]
            own = _later(np.swapaxes(Z, 1, 2) @ WZ)[places]
            pull = -_later(np.einsum("nid,ni->nd", WZ, solved.residual))[places]
            known = np.linalg.solve(solved.precision, np.hstack([*shared]))
            known = known.reshape(J.shape[2], len(places), -1).swapaxes(0, 1)
            covariance = np.linalg.inv(own - np.swapaxes(shared, 1, 2) @ known + 1e-9 * np.eye(Z.shape[2]))
            step = np.einsum("kde,ke->kd", covariance, pull)
            explained = np.einsum("kd,kd->k", step, pull) / (3.0 * n)
            log = solved.log_evidence - 1.5 * n * np.log1p(-np.clip(explained, 0.0, 0.99))
            log += _by_sizes(step, covariance) + 0.5 * np.linalg.slogdet(covariance)[1]
            log -= special.logsumexp([one.log_evidence for one in self._none]) + np.log(len(places) * kinds)
            if log.max() > best:
                best_at = int(places[log.argmax()])
                best = float(log.max())
        return [best_at] if best_at else []

    def _apart(self, kind: Reading) -> list[int]:
        """Find the places that are best beside X of all, of the earlier half and of the later half."""
        n = len(self._views)
        found = []
        for part in (np.arange(n), np.arange((n + 1) // 2), np.arange(n // 2, n)):
            try:
                fit = self._fit if len(part) == n else fit_poses(self._views.part(part), self._seed)
            except np.linalg.LinAlgError:
                continue
            found += self._beside(kind, fit)
        return list(dict.fromkeys(found))

    def _beside(self, kind: Reading, fit: PoseFit) -> list[int]:
        """Find the place with the likeliest change of the views before or behind it, by medians."""
        n, column = len(self._views), self._columns(kind)
        linear = linearise(self._views, fit.X, fit.Y, fit.factors)
        needed = -np.einsum("ndi,ni->nd", np.linalg.pinv(linear.J[..., column]), linear.m)
        scales = fit.solved.scales
        S, S_inverse = linear.noise(scales)
        alone = class_chances(linear.m, S, S_inverse, scales.shares)[1]
        best_at = 0
        best = 0.0
        places = self._places
        for at in places[:: 1 + len(places) // _MOST_PLACES]:
            for some in (slice(at, n), slice(0, at)):
                step = np.median(needed[some], axis=0)
                moved = linear.m[some] + linear.J[some, :, column] @ step
                log = class_chances(moved, S[some], S_inverse[some], scales.shares)[1]
                gain = float(log.sum() - alone[some].sum())
                if gain > best:
                    best_at = int(at)
                    best = gain
        return [best_at] if best_at else []

    def _weighed(self, kind: Reading, at: int) -> _Weighed | None:
        """Weigh a change near `at` over all its places; None where too few views agree with it."""
        weighed = None
        for _ in range(_MOST_FITS):
            weighed = self._fitted_at(kind, at)
            if weighed is None or weighed.best == at:
                break
            at = weighed.best
        return weighed if weighed is not None and weighed.agrees else None

    def _fitted_at(self, kind: Reading, at: int) -> _Weighed | None:
        """Fit a change before view `at` and weigh it at each place near; once, however often it is asked."""
        if (kind, at) not in self._fitted:
            sides = self._sides(kind, at)
            self._fitted[kind, at] = None if sides is None else self._by_place(sides, at)
        return self._fitted[kind, at]

    def _change(self, kind: Reading, weighed: _Weighed, kinds: int, log_rival: float) -> Change:
        """Hold a change against the best of its rivals."""
        chance = np.exp(weighed.logs - special.logsumexp(weighed.logs))
        first, last = _held(chance, int(weighed.logs.argmax()))
        prior = np.log(len(self._places) * kinds)
        log_bayes = float(special.logsumexp(weighed.logs) - prior - log_rival)
        places = weighed.places
        factor = 1.0 + float(weighed.apart[0]) if kind is Reading.REFOCUSED else 1.0
        return Change(kind, log_bayes, weighed.best, int(places[first]), int(places[last]), factor)

    def _by_place(self, sides: _Sides, at: int) -> _Weighed:
        """Weigh the change that `sides` were fitted for, before view `at`, at each place near."""
        count = len(sides.apart)
        linear = sides.split(at)
        solved = [
            linear.solve(_with_change(prior, count), none.scales, "robot", _ROUNDS)
            for prior, none in zip(sides.priors, self._none, strict=True)
        ]
        logs = np.array([_log_of_change(one, sides.apart) for one in solved])
        likeliest = solved[int(logs.argmax())]
        prior = _with_change(sides.priors[int(logs.argmax())], count)
        places = self._places[np.abs(self._places - at) <= _NEAREST]
        beside = [
            sides.split(int(place)).solve(prior, likeliest.scales, "robot", _ROUNDS_BESIDE)
            for place in places
        ]
        by_place = np.array([_log_of_change(one, sides.apart) for one in beside])
        # Where the sides were fitted, the sizes of the arm's errors are averaged; elsewhere the evidence
        # differs by as much as for the likeliest size.
        here = by_place[int(np.flatnonzero(places == at)[0])]
        averaged = float(special.logsumexp(logs) - np.log(len(logs)))
        by_place += averaged - here
        ordinary = likeliest.chances[:, 0] > _AGREES
        agrees = min(ordinary[:at].sum(), ordinary[at:].sum()) >= FEWEST_PER_PART
        # One more term of the arm's errors, as large as those by its posture; no arm changes a focal length.
        steps = [
            _log_of_step(one, sides.apart, LINKS * ARM_ERROR_UNIT * size) if count == _POSE else -np.inf
            for one, size in zip(solved, _SIZES, strict=True)
        ]
        log_step = float(special.logsumexp(steps) - np.log(len(steps)))
        return _Weighed(places, by_place, log_step, likeliest.scales, sides.apart, bool(agrees))

    def _log_none(self, starts: list[Scales]) -> float:
        """Log evidence of no change, the sizes averaged: the most from the noise without and with changes."""
        logs = np.array([one.log_evidence for one in self._none])
        for scales in starts:
            again = [self._linear.solve(prior, scales, "robot", _ROUNDS) for prior in self._priors]
            logs = np.maximum(logs, [one.log_evidence for one in again])
        return float(special.logsumexp(logs) - np.log(len(logs)))

    @property
    def _places(self) -> NDArray[np.intp]:
        return np.arange(FEWEST_PER_PART, len(self._views) - FEWEST_PER_PART + 1)

    def _columns(self, kind: Reading) -> slice:
        """Columns of J by which a change of this kind moves a view."""
        if kind is Reading.CAMERA_MOVED:
            return slice(0, 6)
        return slice(6, 12) if kind is Reading.BOARD_MOVED else slice(12 + FOCAL, 13 + FOCAL)

    def _sides(self, kind: Reading, at: int) -> _Sides | None:
        """Fit a change before view `at`: the views by the values on either side."""
        later = np.arange(len(self._views)) >= at
        if kind is Reading.REFOCUSED:
            views = replace(self._views, boards=refocused(self._views.boards, later))
        else:
            moved: Moved = "camera" if kind is Reading.CAMERA_MOVED else "board"
            views = replace(self._views, later=later, moved=moved)
        try:
            fit = fit_poses(views, self._seed)
        except np.linalg.LinAlgError:
            return None
        before = _State(fit.X[0], fit.Y[0], fit.factors)
        after = _State(fit.X[-1], fit.Y[-1], fit.factors)
        if kind is Reading.REFOCUSED:
            before = replace(before, factors=fit.factors[:-1])
            after = replace(after, factors=np.append(fit.factors[:-2], fit.factors[-1]))
        own = {
            Reading.CAMERA_MOVED: difference(after.X, before.X),
            Reading.BOARD_MOVED: difference(after.Y, before.Y),
            Reading.REFOCUSED: after.factors[FOCAL:] - before.factors[FOCAL:],
        }
        return _Sides(
            self._linearised(before),
            self._linearised(after),
            self._columns(kind),
            own[kind],
            [self._prior(before.factors, size) for size in _SIZES],
        )

    def _linearised(self, state: _State) -> Linear:
        linear = linearise(self._views, state.X[None], state.Y[None], state.factors)
        return replace(linear, J=np.concatenate([linear.J, -self._errors], axis=2))

    def _prior(self, factors: Array, size: float) -> Quadratic:
        """Make the prior of X, Y, factors and errors by posture of this size (mm and mrad)."""
        base, count = pose_prior(self._views.boards, 2, factors), self._errors.shape[2]
        sigma = ARM_ERROR_UNIT * size
        return _wider(base, np.full(count, sigma**-2.0), -count * float(np.log(sigma)))


def _wider(prior: Quadratic, precision: Array, log: float = 0.0) -> Quadratic:
    """Add unknowns about 0 with these precisions (p,)."""
    at, size = len(prior.right), len(prior.right) + len(precision)
    N = np.zeros((size, size))
    N[:at, :at] = prior.N
    N[np.arange(at, size), np.arange(at, size)] = precision
    return Quadratic(N, np.append(prior.right, np.zeros(len(precision))), prior.log + log)


def _with_change(prior: Quadratic, size: int) -> Quadratic:
    """Add a change about which nothing is known: `_log_of_change` gives it its prior."""
    return _wider(prior, np.full(size, 1e-9))


def _log_of_change(solved: LinearSolution, apart: Array) -> float:
    """Compute the log evidence of a solution whose last unknowns are a change, beside `apart` (d,)."""
    d = len(apart)
    covariance = _of_last(solved, d)
    return solved.log_evidence + float(_by_sizes(apart + solved.step[-d:], covariance))


def _log_of_step(solved: LinearSolution, apart: Array, sigma: float) -> float:
    """Compute the same for a step, beside `apart` (6,), whose parts have this 1σ (metres, radians)."""
    covariance = _of_last(solved, _POSE) + sigma**2 * np.eye(_POSE)
    step = apart + solved.step[-_POSE:]
    square = float(step @ np.linalg.solve(covariance, step))
    return solved.log_evidence - 0.5 * (square + float(np.linalg.slogdet(covariance)[1]))


def _of_last(solved: LinearSolution, d: int) -> Array:
    """Return the covariance (d, d) of the last unknowns of a solution."""
    root = solved.inverse.root[-d:]
    return root @ root.T


def _by_sizes(change: Array, covariance: np.ndarray) -> Array:
    """Compute what a change (..., d) costs, with covariance (..., d, d): its prior over a flat one (...).

    Of a pose's change, the sizes of shift and turn are averaged independently.
    """
    d = change.shape[-1]
    sizes = _CHANGE_SIZES[:, None]
    if d == _POSE:
        shift, turn = np.meshgrid(_CHANGE_SIZES, _CHANGE_SIZES)
        sizes = np.repeat(np.stack([shift.ravel(), turn.ravel()], axis=1), 3, axis=1)
    total = covariance[..., None, :, :] + sizes[:, :, None] ** 2 * np.eye(d)
    square = np.einsum(
        "...si,...si->...s", change[..., None, :], np.linalg.solve(total, _column(change, total))[..., 0]
    )
    log = -0.5 * (square + np.linalg.slogdet(total)[1])
    return np.asarray(special.logsumexp(log, axis=-1) - np.log(len(sizes)))


def _column(change: Array, total: Array) -> Array:
    return np.broadcast_to(change[..., None, :, None], (*total.shape[:-1], 1))


def _later(by_view: Array) -> Array:
    """Sum (n, ...) from each view on."""
    return np.asarray(by_view[::-1].cumsum(axis=0)[::-1])


def _held(chance: Array, best: int) -> tuple[int, int]:
    """Find the ends of the shortest range about `best` whose chances add up to `HELD`."""
    first = last = best
    while chance[first : last + 1].sum() < HELD and (first > 0 or last < len(chance) - 1):
        before = chance[first - 1] if first > 0 else -1.0
        after = chance[last + 1] if last < len(chance) - 1 else -1.0
        if before > after:
            first -= 1
        else:
            last += 1
    return first, last


def refocused(boards: BoardPoses, later: NDArray[np.bool_]) -> BoardPoses:
    """Give views before and after a change a focal length each; the last factor is that of the later ones."""
    focal = boards.motion[FOCAL]
    parts = np.stack([focal * ~later[:, None], focal * later[:, None]])
    return replace(
        boards,
        motion=np.concatenate([boards.motion[:FOCAL], parts]),
        sigma=np.array([*boards.sigma[:FOCAL], FREE, FREE]),
    )
