"""One cell: a real arm, a camera and a board, what was recorded of them, and the truth.

At the moment s of a session (0 at its first view, 1 at its last and ever after), with R the room's frame:

    camera in hand:  camera_from_board = (F*(q, s) H X)⁻¹ Y(s)
    fixed camera:    camera_from_board = X(s)⁻¹ F*(q, s) H Y

F* is where the flange really is in the arm's base; H turns what the flange holds, where a kind lets it slip
or swing; Y(s) of a board in the room and X(s) of a camera in the room move against a base that drifts. The
controller tells F, its table at the joints that its encoders show. All of it is by `frames`, `lenses` and
`arms`; nothing here knows how it will be solved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.judge.arms import ARMS, ArmClass, Chain, gravity_share, solve_joints
from benchmarks.judge.frames import (
    Array,
    Flags,
    Places,
    apply,
    cross_matrix,
    inverse,
    pose,
    rotation,
    small_motion,
    unit,
)
from benchmarks.judge.kinds import EVERY, Kind, drawn
from benchmarks.judge.lenses import LENSES, Lens

COLUMNS = 9
ROWS = 7
CORNER_PX = 0.12
"""1σ of a corner of a sharp picture, per axis."""
FEWEST_CORNERS = 12
MOUNTS = ("eye-in-hand", "eye-to-hand")
_MARGIN_PX = 8.0


class NoCellError(Exception):
    """The arm does not reach enough views of the board."""


@dataclass(frozen=True)
class Name:
    """Which cell: the same name gives the same cell."""

    kind: str
    arm: str
    mount: str
    joints: bool
    """The joints were recorded, too."""
    draw: int
    seed: int
    told: bool = True
    """The arm's class is told; else it is an unknown arm."""

    @property
    def numbers(self) -> list[int]:
        """Seeds of the cell. `joints` and `told` are none: it is the same recording with and without."""
        return [self.draw, self.seed, *f"{self.kind}/{self.arm}/{self.mount}".encode()]


@dataclass(frozen=True, eq=False)
class World:
    """The real arm, and what camera, board and flange do in a session."""

    kind: Kind
    arm: ArmClass
    real: Chain
    in_hand: bool
    X: Array
    """(4, 4) flange_from_camera or base_from_camera, at s = 1; of a bracket that swings, its middle."""
    Y: Array
    """(4, 4) base_from_board at s = 1, or flange_from_board."""
    encoder: Array
    """(3, n) amplitude and phase of each encoder's error and its zero, radians."""
    base_drift: Array
    """(6,) motion of the room in base, from s = 0 to 1."""
    bump: Array
    """(6,) motion of the camera in its own frame, half-way."""

    def joints(self, q: Array, arrived_up: Array, rng: np.random.Generator) -> Array:
        """Real joints (m, n) where the encoders show q (m, n).

        arrived_up: (m, n) ±1, the direction in which each joint came to rest.
        """
        kind = self.kind
        unit_rad = self.arm.zero_rad
        amplitude, phase, zero = self.encoder
        real = q + zero + amplitude * np.sin(q + phase)
        real = real - 0.5 * kind.backlash * unit_rad * arrived_up
        real = real + kind.sag * unit_rad * gravity_share(self.arm.chain, q, self.arm.reach_m)
        return np.asarray(real + self.arm.repeat_rad * rng.normal(size=q.shape))

    def flange(self, q_real: Array, s: Array | float = 1.0) -> Array:
        """F* (m, 4, 4) of real joints (m, n)."""
        if not self.kind.growth:
            return self.real.flange(q_real)
        grown = self.kind.growth * (1.0 - np.exp(-3.0 * np.broadcast_to(s, len(q_real))))
        return np.array([self.real.grown(float(g)).flange(q) for g, q in zip(grown, q_real, strict=True)])

    def held(self, flange: Array, s: Array | float = 1.0) -> Array:
        """H (m, 4, 4), how what the flange holds is turned, where the flange really is (m, 4, 4)."""
        s = np.broadcast_to(s, len(flange))
        steps = np.minimum(np.floor(4.0 * s), 3.0) / 3.0 - 1.0
        turn = np.outer(1e-3 * self.kind.slip_mrad * steps, [0.0, 0.0, 1.0])
        down = -flange[:, 2, :3]  # gravity in the flange's frame
        outwards = unit((self.X if self.in_hand else self.Y)[:3, 3])
        # It falls to the lower end of its play unless it hangs nearly in balance.
        torque = np.cross(outwards, down)
        turn = turn + 0.5e-3 * self.kind.loose_mrad * np.tanh(3.0 * torque)
        return pose(rotation(turn), np.zeros(3))

    def camera_from_board(self, flange: Array, s: Array | float = 1.0) -> Array:
        """What a camera sees (m, 4, 4) where the flange really is (m, 4, 4)."""
        s = np.broadcast_to(s, len(flange))
        before = np.where(s < 0.5, 1.0, 0.0)[:, None]
        bumped = self.X @ small_motion(-before * self.bump)
        room = small_motion((s - 1.0)[:, None] * self.base_drift)
        held = flange @ self.held(flange, s)
        if self.in_hand:
            return np.asarray(inverse(held @ bumped) @ room @ self.Y)
        return np.asarray(inverse(room @ bumped) @ held @ self.Y)

    def points(self, flange: Array, at: Array) -> Array:
        """The point (m, 3) in base that a camera in hand shows at `at` (3,) of its own frame."""
        return apply(flange @ self.held(flange) @ self.X, at)


@dataclass(frozen=True, eq=False)
class View:
    """One picture, and what the controller told with it."""

    flange: Array
    """(4, 4) base_from_flange as told."""
    joints: Array
    """(n,) as told."""
    points: Array
    """(k, 3) the corners on the stated board."""
    pixels: Array
    """(k, 2)"""


@dataclass(frozen=True, eq=False)
class Cell:
    name: Name
    world: World
    views: tuple[View, ...]
    shown: Array
    """(n, joints) what the encoders showed, unrounded."""
    told: Array
    """(n, 4, 4) flanges as told."""
    seen: Array
    """(n, 4, 4) true camera_from_board."""
    X: Array
    """(4, 4) the real camera in the real flange or base, after the session."""
    lens: Lens
    """The true one."""
    given: Lens | None
    """As told; None: to be found."""
    given_told: float
    """1σ that is told of it, relative."""
    board_m: float
    """Size of the squares as stated."""


def make(name: Name) -> Cell:
    """The cell of this name. NoCellError where its arm does not reach enough views."""
    return make_of(name, drawn(EVERY[name.kind], name.draw), ARMS[name.arm])


def make_of(name: Name, kind: Kind, arm: ArmClass) -> Cell:
    """The same of a kind and an arm that need not be in the tables; the name is its seed."""
    rng = np.random.default_rng(name.numbers)
    lens = _lens(kind)
    board = board_points(arm.board_m)
    world = _world(kind, arm, name.mount == "eye-in-hand", board, rng)
    q = _postures(world, lens, board, rng)
    return record(name, world, lens, q, rng)


def record(name: Name, world: World, lens: Lens, q: Array, rng: np.random.Generator) -> Cell:
    """Take a view at each of the postures q (n, joints), one after the other."""
    kind = world.kind
    arm = world.arm
    count = len(q)
    s = np.linspace(0.0, 1.0, count)
    came = np.sign(np.diff(q, axis=0, prepend=np.array(arm.home)[None]) + 1e-12)
    real = world.joints(q, came, rng)
    creeps = rng.permutation(count) < count / 3
    left = kind.creep * arm.zero_rad * np.abs(rng.normal(size=(count, 1)))
    real = real - np.where(creeps[:, None], left * came, 0.0)
    flange = world.flange(real, s)
    seen = world.camera_from_board(flange, s)
    told_q = told_joints(kind, q)
    told = rounded(noisy(kind, arm.chain.flange(told_q), rng), kind.told_mm)
    board = board_points(arm.board_m)
    printed = _printed(kind, board, rng)
    pixels = _pictures(kind, lens, seen, printed, s, rng)
    shown = _shown(kind, board, count, rng)
    views = tuple(View(told[i], told_q[i], board[shown[i]], pixels[i, shown[i]]) for i in range(count))
    X = world.X
    if kind.loose_mrad and world.in_hand:
        X = world.X.copy()
        X[:3, :3] = _mean_rotation((world.held(flange, s) @ world.X)[:, :3, :3])
    given = _given(kind, lens, rng) if kind.given else None
    return Cell(name, world, views, q, told, seen, X, lens, given, kind.given_told, arm.board_m)


def board_points(square_m: float) -> Array:
    """(k, 3) corners of the board, row by row from its origin."""
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    return np.column_stack([square_m * x.ravel(), square_m * y.ravel(), np.zeros(x.size)])


def told_joints(kind: Kind, q: Array) -> Array:
    """Joints (m, n) as they are told where the encoders show q (m, n)."""
    step = np.radians(kind.told_joint_deg)
    return np.asarray(np.round(q / step) * step) if step else q


def noisy(kind: Kind, flange: Array, rng: np.random.Generator) -> Array:
    """Flanges (m, 4, 4) with the new error that each of them has where the kind has such an error."""
    return np.asarray(flange @ small_motion(1e-3 * kind.noise_mm * rng.normal(size=(len(flange), 6))))


def rounded(told: Array, step_mm: float) -> Array:
    """Poses (m, 4, 4) rounded: positions to `step_mm`, angles about x, y, z to as many tenths of a degree."""
    if not step_mm:
        return told
    step_m = 1e-3 * step_mm
    step_rad = np.radians(0.1 * step_mm)
    R = told[:, :3, :3]
    angles = np.stack(
        [
            np.arctan2(R[:, 2, 1], R[:, 2, 2]),
            np.arcsin(np.clip(-R[:, 2, 0], -1.0, 1.0)),
            np.arctan2(R[:, 1, 0], R[:, 0, 0]),
        ],
        axis=-1,
    )
    about = np.round(angles / step_rad) * step_rad
    turns = [rotation(about[:, i : i + 1] * np.eye(3)[i]) for i in range(3)]
    return pose(turns[2] @ turns[1] @ turns[0], np.round(told[:, :3, 3] / step_m) * step_m)


def _lens(kind: Kind) -> Lens:
    lens = LENSES[kind.lens]
    fisheye = lens.model == "equidistant"
    focal_px = lens.focal_px[0] / kind.stronger if fisheye else lens.focal_px[0]
    distortion = lens.distortion
    if not fisheye:
        distortion = tuple(kind.stronger * k for k in distortion)
    return Lens(lens.model, (focal_px, focal_px * (1.0 + kind.aspect)), lens.centre_px, distortion)


def _world(kind: Kind, arm: ArmClass, in_hand: bool, board: Array, rng: np.random.Generator) -> World:
    """Place camera and board so that the arm near its home posture shows the board's middle."""
    n = arm.chain.joints
    scale = arm.distance_m[1] / 0.62
    held = pose(rotation(0.3 * rng.normal(size=3)), scale * (0.05 * rng.normal(size=3) + [0.0, 0.0, 0.09]))
    # In the room, the other one is where the home posture shows the board square on.
    turn = rotation([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    distance_m = kind.farther * float(np.mean(arm.distance_m))
    shown = pose(turn, np.array([0.0, 0.0, distance_m]) - turn @ board.mean(axis=0))
    home = np.array(arm.home) + 0.15 * rng.normal(size=n)
    flange = arm.chain.flange(home)
    if in_hand:
        X = held
        Y = flange @ X @ shown
    else:
        # The board is held with its face ahead of the flange, towards the camera.
        Y = held @ pose(rotation([np.pi, 0.0, 0.0]), np.zeros(3))
        X = flange @ Y @ inverse(shown)
    amplitude = kind.eccentric * arm.zero_rad * rng.normal(size=n)
    phase = rng.uniform(0, 2 * np.pi, n)
    zero = np.zeros(n)
    zero[rng.integers(1, n - 1)] = rng.choice([-1.0, 1.0]) * kind.remastered * arm.zero_rad
    drift = 1e-3 * kind.base_drift_mm * np.concatenate([unit(rng.normal(size=3)), unit(rng.normal(size=3))])
    way = np.concatenate([unit(rng.normal(size=3)), 2.0 * unit(rng.normal(size=3))])
    bump = 1e-3 * kind.bump_mm * way
    real = arm.real(rng, kind.links)
    return World(kind, arm, real, in_hand, X, Y, np.array([amplitude, phase, zero]), drift, bump)


def _postures(world: World, lens: Lens, board: Array, rng: np.random.Generator) -> Array:
    """Joints (n, joints) of views that show all of the board, as the kind places them."""
    kind = world.kind
    arm = world.arm
    found: list[Array] = []
    places: list[Array] = []
    for attempt in range(30):
        # Less of a tilt where the arm does not reach.
        ease = 0.93**attempt
        if kind.clusters:
            while len(places) < kind.clusters:
                places.extend(_looks(kind, arm, lens, board, rng, ease, 1))
            near = [places[i] for i in rng.integers(0, kind.clusters, 3 * kind.views)]
            shift = small_motion(rng.normal(size=(len(near), 6)) * np.repeat([0.01, 0.03], 3))
            looks = np.array(near) @ shift
        else:
            looks = np.array(_looks(kind, arm, lens, board, rng, ease, 3 * kind.views))
        target = world.Y @ inverse(looks) @ inverse(world.X)
        if not world.in_hand:
            target = world.X @ looks @ inverse(world.Y)
        q, reached = solve_joints(arm, target, np.array(arm.home))
        # The real arm's picture must show the whole board, too.
        real = world.camera_from_board(world.flange(q))
        ok = reached & _inside(lens, _pixels(lens, real, board))
        found.extend(q[ok])
        if kind.clusters and attempt % 5 == 4 and not found:
            places.clear()
        if len(found) >= kind.views:
            return np.array(found[: kind.views])
    raise NoCellError(f"{len(found)} of {kind.views} views")


def _looks(
    kind: Kind, arm: ArmClass, lens: Lens, board: Array, rng: np.random.Generator, ease: float, count: int
) -> list[Array]:
    """camera_from_board (4, 4) each, that show the whole board: tilted, turned, anywhere in the picture."""
    middle = board.mean(axis=0)
    size = np.array([lens.width, lens.height])
    low, high = arm.distance_m
    found: list[Array] = []
    while len(found) < count:
        m = 4 * count
        tilt = ease * np.radians(kind.tilt_deg) * np.sqrt(rng.uniform(0, 1, m))
        about = rng.uniform(0, 2 * np.pi, m)
        roll = rng.uniform(-np.pi / 2, np.pi / 2, m)
        lean = rotation(tilt[:, None] * np.column_stack([np.cos(about), np.sin(about), np.zeros(m)]))
        R = rotation(np.outer(roll, [0.0, 0.0, 1.0])) @ lean
        z = kind.farther * rng.uniform(low, high, m)
        aim = rng.uniform(-0.45, 0.45, (m, 2)) * size / lens.focal_px[0] * z[:, None]
        C = pose(R, np.column_stack([aim, z]) - R @ middle)
        found.extend(C[_inside(lens, _pixels(lens, C, board))])
    return found[:count]


def _pixels(lens: Lens, C: Array, board: Array) -> Array:
    return lens.project(board @ np.swapaxes(C[:, :3, :3], 1, 2) + C[:, None, :3, 3])


def _inside(lens: Lens, pixels: Array) -> Flags:
    far = np.array([lens.width, lens.height]) - 1 - _MARGIN_PX
    return np.asarray(((pixels > _MARGIN_PX) & (pixels < far)).all(axis=(1, 2)))


def _printed(kind: Kind, board: Array, rng: np.random.Generator) -> Array:
    """(k, 3) the board as it is: its print's two scales, and bent about any axis in its plane."""
    sign = rng.choice([-1.0, 1.0], 3)
    about = rng.uniform(0, np.pi)
    low = board[:, :2].min(axis=0)
    high = board[:, :2].max(axis=0)
    across = (2 * board[:, :2] - low - high) / (high - low) @ [np.cos(about), np.sin(about)]
    scale = 1.0 + sign[:2] * [kind.print_x, kind.print_y]
    height = sign[2] * 1e-3 * kind.bend_mm * (1.0 - across**2)
    return np.column_stack([board[:, :2] * scale, height])


def _pictures(
    kind: Kind, lens: Lens, seen: Array, printed: Array, s: Array, rng: np.random.Generator
) -> Array:
    """(n, k, 2) pixels of the corners, as a detector finds them."""
    n = len(seen)
    k = len(printed)
    points = printed @ np.swapaxes(seen[:, :3, :3], 1, 2) + seen[:, None, :3, 3]
    z = points[:, :, 2].mean(axis=1)
    focus = 1.0 / z - 1.0 / np.median(z)
    scale = (1.0 + 1e-3 * kind.breathing_mm * focus) * (1.0 + kind.focal_drift * (s - 0.5))
    scale = scale[:, None, None]
    pixels = lens.project(points, scale)
    if kind.rolling_mm:
        way = 1e-3 * kind.rolling_mm * rng.normal(size=(n, 6)) / np.sqrt(3)
        for _ in range(3):
            # A row is read when the camera has moved by so much of its way.
            part = pixels[:, :, 1:] / lens.height - 0.5
            moved = way[:, None, :3] + points @ np.swapaxes(cross_matrix(way[:, 3:]), 1, 2)
            pixels = lens.project(points + part * moved, scale)
    # A picture off its focus by a dioptre is twice as uncertain.
    sigma = CORNER_PX * (1.0 + (np.abs(focus) if kind.breathing_mm else 0.0 * focus))[:, None, None]
    pixels = pixels + sigma * rng.normal(size=(n, k, 2))
    if kind.dirt_px:
        size = np.array([lens.width, lens.height])
        for _ in range(4):
            spot = rng.uniform(0.15, 0.85, 2) * size
            push = kind.dirt_px * unit(rng.normal(size=2))
            near = np.exp(-0.5 * (np.linalg.norm(pixels - spot, axis=-1, keepdims=True) / 40.0) ** 2)
            pixels = pixels + near * (push + kind.dirt_px * rng.normal(size=(n, k, 2)) / 3)
    return np.asarray(pixels)


def _shown(kind: Kind, board: Array, count: int, rng: np.random.Generator) -> list[Places]:
    """Rows of the board that each of the `count` pictures shows."""
    every = np.arange(len(board))
    shown = []
    for hidden in rng.permutation(count) < (count / 2 if kind.occluded else 0):
        if not hidden:
            shown.append(every)
            continue
        about = rng.uniform(0, 2 * np.pi)
        along = board[:, :2] @ [np.cos(about), np.sin(about)]
        kept = len(board) - int(len(board) * kind.occluded * rng.uniform(0.3, 1.0))
        shown.append(np.sort(np.argsort(along)[: max(kept, FEWEST_CORNERS)]))
    return shown


def _given(kind: Kind, lens: Lens, rng: np.random.Generator) -> Lens:
    """The lens as its maker tells it: off by `given_error`."""
    off = kind.given_error * rng.normal(size=3)
    focal = (lens.focal_px[0] * (1.0 + off[0]), lens.focal_px[1] * (1.0 + off[0]))
    centre = (lens.centre_px[0] + lens.width * off[1], lens.centre_px[1] + lens.width * off[2])
    return Lens(lens.model, focal, centre, lens.distortion)


def _mean_rotation(R: Array) -> Array:
    """The rotation nearest to those of R (m, 3, 3), by the sum of their matrices."""
    U, _, Vt = np.linalg.svd(R.sum(axis=0))
    return np.asarray(U @ Vt)
