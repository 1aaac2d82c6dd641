"""Mistakes while setting up and starting a cell, and whether the true cause is named first.

Decided by codes; the sentence that is read first stands beside them. The cells are our own simulation.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import socket
import tempfile
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

import station
from benchmarks.trials import table
from calibrate.boards.detect import detect
from calibrate.geometry import Array, inverse, pose, rotation_exp
from calibrate.kinematics import MODELS, forward
from recordings.errors import CodedError
from recordings.schema.messages import BoardKind, BoardSpec, Image, Stamps
from station.cell.config import RobotConfig, matrix4, vector6
from station.cell.config_file import examine_config
from station.cell.plan import Plan, PlannedPose
from station.cell.status import StationState
from station.cli.new import RealHardware
from station.devices.ur import UrRobot
from station.operate.draft import Draft
from station.operate.guided_views import find_cell, image_trouble
from station.protocol.verbs import Purpose
from station.simulation.launch import SimulatedController, start_controller
from station.simulation.renderer import Light, render
from station.simulation.scenes import make_cell
from tests.station.operate.guided_views import draft_of
from tests.station.session_rig import Rig

NOBODY, OTHER_DEVICE = "127.99.0.1", "127.99.0.2"
TRUTH = make_cell("paper", seed=3, noise="mid")
PICTURED = make_cell("paper-binned", seed=3, noise="mid")
"""Small images: the board is looked for in a fourth of the time."""
WAIT_S = 10.0


class Said(NamedTuple):
    """First message to the operator."""

    code: str
    text: str


Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class Mistake:
    name: str
    causes: tuple[str, ...]
    """Codes that name the true cause."""
    plant: Callable[[], Awaitable[Said]]


def _config(old: str, new: str) -> Callable[[], Awaitable[Said]]:
    """A mistake in the configuration, told by `station doctor --config`."""

    async def plant() -> Said:
        text = (Path(station.__file__).parent / "example.yaml").read_text()
        assert old in text
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "station.yaml"
            path.write_text(text.replace(old, new))
            first = [*(report := examine_config(path)).wrong, *report.missing][0]
        return Said(first.where, str(first))

    return plant


def _raised(work: Callable[[], Awaitable[object]]) -> Callable[[], Awaitable[Said]]:
    async def plant() -> Said:
        try:
            await work()
        except CodedError as problem:
            return Said(problem.code, str(problem))
        return Said("", "nothing was said")

    return plant


async def _wrong_address() -> None:
    await RealHardware().arm(NOBODY)


async def _other_device() -> None:
    with contextlib.ExitStack() as ends:
        for port in (29999, 30002, 30004):
            ends.enter_context(socket.create_server((OTHER_DEVICE, port)))
        await RealHardware().arm(OTHER_DEVICE)


def _robot(
    fault: Callable[[SimulatedController], object], model: str = "UR10", wrong: str = "", start: bool = True
) -> Callable[[], Awaitable[Said]]:
    """A fault at the pendant; told when a motion is approved (`start`), or while nothing moves."""

    async def work() -> None:
        with start_controller(model) as controller, tempfile.TemporaryDirectory() as folder:
            robot = UrRobot(RobotConfig(model=model, host=controller.host, serial=wrong), Path(folder))
            try:
                await robot.connect()
                fault(controller)
                if start:
                    await asyncio.sleep(0.3)
                    robot.heartbeat()
                    await robot.start_control()
                else:
                    async with asyncio.timeout(WAIT_S):
                        while True:
                            robot.check()
                            await asyncio.sleep(0.1)
            finally:
                await robot.close()

    return _raised(work)


def _admin(cmd: str, **arguments: object) -> Callable[[SimulatedController], object]:
    def ask(controller: SimulatedController) -> None:
        with controller.admin() as admin:
            admin.ask(cmd, **arguments)

    return ask


def _seen() -> Array:
    """camera_from_board at the start."""
    flange = forward(MODELS[PICTURED.robot_model], np.array(PICTURED.start_joints_rad))
    return np.asarray(inverse(flange @ np.array(PICTURED.camera_mount)) @ np.array(PICTURED.board_place))


def _picture(
    edit: Callable[[Grey], Grey] = lambda image: image,
    light: Light | None = None,
    board: BoardSpec = PICTURED.board,
    away: Array | None = None,
) -> Callable[[], Awaitable[Said]]:
    """A fault of the picture, told beside it."""

    async def plant() -> Said:
        rng = np.random.default_rng(0)
        seen = _seen() if away is None else away @ _seen()
        pixels = np.ascontiguousarray(edit(render(PICTURED.camera, PICTURED.board, seen, light, rng))).astype(
            np.uint8
        )
        image = Image(pixels, Stamps(), None, 0, exposure_us=10_000.0)
        return Said(*image_trouble(image, detect(pixels, board)))

    return plant


def _views(change: Callable[[Draft], Draft]) -> Callable[[], Awaitable[Said]]:
    """A mistake that only the guided views show."""

    async def plant() -> Said:
        found = find_cell(change(draft_of(TRUTH)))
        return Said("", "nothing was found") if found is None else Said(found.cause, found.warning)

    return plant


def _moved(places: tuple[int, ...], off: Array, of_flange: bool) -> Callable[[Draft], Draft]:
    """The board moved in the cell, or the camera on the flange, before these views."""

    def change(draft: Draft) -> Draft:
        views = list(draft.views)
        for place in places:
            T = np.array(views[place].base_from_flange)
            moved = T @ off if of_flange else off @ T
            views[place] = msgspec.structs.replace(views[place], base_from_flange=matrix4(moved))
        return msgspec.structs.replace(draft, views=tuple(views))

    return change


def _square(draft: Draft) -> Draft:
    assert draft.board is not None
    return msgspec.structs.replace(draft, board=msgspec.structs.replace(draft.board, square_m=0.0265))


def _session(free_bytes: int, turned: float) -> Callable[[], Awaitable[Said]]:
    """A session that is refused before anything moves."""

    async def work() -> None:
        folder = Path(tempfile.mkdtemp())
        rig = Rig(folder)
        config = rig.session.context.cell.config
        capture = msgspec.structs.replace(config.capture, free_space_bytes=free_bytes)
        object.__setattr__(
            rig.session.context.cell, "config", msgspec.structs.replace(config, capture=capture)
        )
        await rig.start()
        try:
            await rig.until(StationState.IDLE)
            rig.session.take_lease(1, "operator")
            joints = np.array(rig.arm.joints)
            joints[5] += turned
            first = PlannedPose("p01", vector6(joints))
            rig.session.load_plan(1, Plan(config.robot.model, config.mount, (first,)))
            await rig.session.prepare(1, Purpose.RUN)
        finally:
            await rig.session.close()
            shutil.rmtree(folder)

    return _raised(work)


def _covered(image: Grey) -> Grey:
    return np.full_like(image, 4)


def _blurred(image: Grey) -> Grey:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 6.0), dtype=np.uint8)


_PLACED = pose(rotation_exp([0.0, 0.01, 0.04]), [0.03, 0.0, 0.02])
_SLIPPED = pose(rotation_exp([0.05, 0.0, 0.03]), [0.0, 0.012, 0.0])
_ASIDE = pose(np.eye(3), [2.0, 0.0, 0.0])
_COUNTED = BoardSpec(kind=BoardKind.CHESSBOARD, columns=8, rows=7, square_m=0.025)
_OTHER = BoardSpec(kind=BoardKind.CHESSBOARD, columns=9, rows=6, square_m=0.025)
_CAMERA_GUESS = """\
camera_guess:                 # flange_from_camera, by tape measure
  translation_m: [0.0, 0.06, 0.05]
  rotation_xyzw: [0.0, 0.0, 0.0, 1.0]
"""
MISTAKES = (
    Mistake("wrong address typed", ("no-robot",), _raised(_wrong_address)),
    Mistake("address of another device", ("robot-incomplete",), _raised(_other_device)),
    Mistake("remote control off", ("local-control",), _robot(_admin("remote", on=False), "UR10e")),
    Mistake("another program plays", ("foreign-program",), _robot(_admin("foreign"))),
    Mistake("emergency stop pressed", ("emergency-stop",), _robot(_admin("estop"))),
    Mistake("another arm than configured", ("other-robot",), _robot(lambda _: None, wrong="4711")),
    Mistake("TCP changed", ("tcp-changed",), _robot(_admin("tcp", pose=[0, 0, 0.12, 0, 0, 0]), start=False)),
    Mistake("focal length in mm", ("camera.model.matrix",), _config("[[1667.0, 0.0", "[[8.0, 0.0")),
    Mistake("square in mm", ("board", "board.square_m"), _config("square_m: 0.025", "square_m: 25")),
    Mistake(
        "board upside down",
        ("board_guess.rotation_xyzw",),
        _config("rotation_xyzw: [1.0, 0.0, 0.0, 0.0]", "rotation_xyzw: [0.0, 0.0, 0.0, 1.0]"),
    ),
    Mistake(
        "board out of reach",
        ("board_guess.translation_m",),
        _config("translation_m: [0.7, 0.0, 0.0]", "translation_m: [2.9, 0.0, 0.0]"),
    ),
    Mistake("camera_guess left out", ("camera_guess",), _config(_CAMERA_GUESS, "")),
    Mistake("lens covered", ("too-dark",), _picture(_covered)),
    Mistake("board not in view", ("empty", "not-found"), _picture(away=_ASIDE)),
    Mistake("squares counted", ("squares-counted",), _picture(board=_COUNTED)),
    Mistake("another board lies there", ("other-board",), _picture(board=_OTHER)),
    Mistake("out of focus", ("blurred",), _picture(_blurred)),
    Mistake("over-exposed", ("over-exposed",), _picture(light=Light(exposure_us=60_000.0))),
    Mistake("under-exposed", ("under-exposed",), _picture(light=Light(exposure_us=1_500.0))),
    Mistake("square 6 % too large", ("square-size",), _views(_square)),
    Mistake(
        "other mounting chosen",
        ("other-mounting",),
        _views(lambda draft: msgspec.structs.replace(draft, mount="eye-to-hand")),
    ),
    Mistake("board moved", ("moved",), _views(_moved((2, 3), _PLACED, of_flange=False))),
    Mistake("loose camera mount", ("moved",), _views(_moved((3,), _SLIPPED, of_flange=True))),
    Mistake("disk full", ("disk-full",), _session(10**15, 0.1)),
    Mistake("arm jogged since planning", ("planned-elsewhere",), _session(1, 3.4)),
)


async def said_of(mistake: Mistake) -> Said:
    """Plant one; what is said first."""
    return await mistake.plant()


def run() -> str:
    rows = []
    for mistake in MISTAKES:
        said = asyncio.run(said_of(mistake))
        text = " ".join(said.text.split()).replace("|", "/")
        right = said.code in mistake.causes
        rows.append([mistake.name, said.code or "–", "yes" if right else "no", text[:110]])
    named = sum(row[2] == "yes" for row in rows)
    head = ["mistake", "code", "true cause", "first sentence"]
    return f"{named} of {len(rows)} named truly.\n\n{table(head, rows)}"
