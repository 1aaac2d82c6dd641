"""The touch test: the pointer's tip over a corner of the board, slowly, well above it, approved each time.

Nothing is recorded and nothing is touched: contact is made by a person's hand only.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrate.boards.model import board_points
from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, read_calibration
from calibrate.files.install import installed_calibration
from calibrate.geometry import Array, pose_from_rotvec
from calibrate.kinematics import forward
from calibrate.views import BoardView
from recordings.schema.messages import Vector6
from station.cell.config import PointerConfig, matrix4
from station.cell.errors import LimitError, RefusedError, RobotError
from station.cell.plan import plan_sha256
from station.cell.scene import flange_pose
from station.cell.status import HoverOffer, StationState
from station.cell.stillness import JOGGED_RAD, NotStillError, RestingCheck
from station.plan.hover import HoverPath, HoverQuestion, answer_hover, least_standoff_m
from station.protocol import verbs
from station.session.context import SessionContext, displacement
from station.session.lease import Drive, MotionApproval
from station.session.run import Run
from station.session.summary import motion_preview, motion_warnings

OVER_CORNER = "over-corner"
"""Cause of the state after a path over a corner: the tip stands there."""
VIEW_LIFETIME_S = 900.0
"""From close above the board a camera on the flange sees nothing: one image serves several corners."""
_PLAN_S = 60.0
_SAME_PLACE_RAD = 1e-3
"""The arm stands where the image was taken: a board seen from elsewhere lies elsewhere."""


@dataclass(frozen=True, eq=False)
class _BoardSeen:
    """The board as last seen."""

    view: BoardView
    place: str
    """Which calibration it was seen by."""
    at_s: float


class TouchTestPlanner:
    """Finds paths over corners; remembers the last image of the board."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self._board: _BoardSeen | None = None

    async def prepare(self, request: verbs.Hover) -> tuple[Drive, HoverOffer]:
        """RefusedError, LimitError, RobotError and CameraError say what is in the way. Nothing moves."""
        context = self._context
        robot, config = context.cell.robot, context.cell.config
        calibration = self._calibration(request)
        pointer, words = self._pointer(request)
        if not 0 <= request.corner <= (last := len(board_points(config.board)) - 1):
            text = f"The board has corners 0 to {last}, not {request.corner}."
            raise RefusedError(text, code="no-such-corner", corner=request.corner, last=last)
        if not request.standoff_m >= (least_m := least_standoff_m(0.0)):
            raise LimitError(
                f"Tip {1000 * request.standoff_m:.0f} mm above the board (limit {1000 * least_m:.0f} mm).",
                code="standoff",
                remedy="Nearer, guide it by hand only.",
                standoff_m=request.standoff_m,
                limit_m=least_m,
            )
        robot.check()
        await context.stillness.settle(RestingCheck(robot.check))
        seen = await self._seen(request, calibration)
        start = robot.latest().joints_rad
        question = HoverQuestion(request.corner, request.standoff_m, pointer, start, self._model_miss_m())
        try:
            hover, covariance, moved_m = await context.workers.call(
                answer_hover, config, calibration, seen.view, question, timeout_s=_PLAN_S
            )
        except CalibrationError as error:
            raise _refused(error) from error
        offer = self._offer(hover, covariance, moved_m, start, seen, pointer, words)
        return lambda go: HoverRun(context, go, hover).drive(), offer

    def _calibration(self, request: verbs.Hover) -> Calibration:
        """A passed calibration of this very cell: a wrong one would put the board somewhere else."""
        cell = self._context.cell
        try:
            if request.calibration:
                found = read_calibration(Path(request.calibration))
            else:
                found = installed_calibration(self._context.root, cell.config.camera.name)
        except CalibrationError as error:
            raise _refused(error) from error
        robot, camera = cell.robot.identity, cell.camera.identity
        here = cell.config.mount
        if found.mount != here or found.source != cell.source:
            text = f"The calibration is {found.source}, {found.mount}; this cell is {cell.source}, {here}."
            raise RefusedError(text, code="other-cell")
        if (found.robot.serial, found.camera.serial) != (robot.serial, camera.serial):
            raise RefusedError(
                f"The calibration is of robot {found.robot.serial} and camera {found.camera.serial}; this "
                f"cell has {robot.serial} and {camera.serial}.",
                code="other-devices",
                robot=found.robot.serial,
                camera=found.camera.serial,
            )
        if found.quality.failed:
            names = ", ".join(gate.name for gate in found.quality.failed)
            text = f"The calibration failed its gates ({names}): nothing is driven by it."
            raise RefusedError(text, code="failed-gates", gates=names)
        return found

    def _pointer(self, request: verbs.Hover) -> tuple[PointerConfig, str]:
        """The pointer and its words: as asked for, as configured, or the tool set on the pendant."""
        configured = self._context.cell.config.pointer
        if request.pointer_m is not None:
            if not 0.01 <= request.pointer_m <= 1.0:
                text = f"A pointer is 10 to 1000 mm long, not {1000 * request.pointer_m:g} mm."
                raise RefusedError(text, code="pointer-length", pointer_m=request.pointer_m)
            pointer = PointerConfig((0.0, 0.0, request.pointer_m))
            return pointer, f"pointer {1000 * request.pointer_m:.1f} mm along the flange's z axis"
        if configured is not None:
            return configured, f"configured pointer, tip at {_mm(configured.tip_m)} mm in the flange"
        tcp = self._context.cell.robot.identity.tcp_offset
        tip, along = tcp[:3], pose_from_rotvec(tcp[:3], tcp[3:])[:3, 2]
        if np.linalg.norm(tip) < 0.01:
            raise RefusedError(
                "The station knows no pointer.",
                code="no-pointer",
                remedy="Give its length (--pointer-mm; Tab on the screen), `pointer` in the configuration, "
                "or set the tool centre point on the pendant.",
            )
        x, y, z = (float(v) for v in along)
        return PointerConfig(tip, (x, y, z)), f"the pendant's tool, tip at {_mm(tip)} mm in the flange"

    async def _seen(self, request: verbs.Hover, calibration: Calibration) -> _BoardSeen:
        context, place = self._context, calibration.provenance.recording_sha256
        if not request.new_picture:
            seen = self._board
            if seen is None or seen.place != place or time.monotonic() - seen.at_s > VIEW_LIFETIME_S:
                text = "The board was not seen lately."
                raise RefusedError(text, code="board-not-seen", remedy="Bring it into the image first.")
            return seen
        self._board = None
        before = context.cell.robot.latest().joints_rad
        image = await context.cell.camera.capture()
        state = await context.arm()
        if np.abs(np.subtract(state.joints_rad, before)).max() > _SAME_PLACE_RAD:
            text = "The arm was moved while the image was taken."
            raise RefusedError(text, code="arm-moved", remedy="Leave it at rest, then retry.")
        sighting = await context.look_at(image, calibration.intrinsics.model)
        if not sighting.status.found:
            raise RefusedError(
                sighting.status.reason or "No board in the image.",
                code="no-board",
                remedy="Jog the arm or lay the board so that the camera sees it whole.",
            )
        flange = flange_pose(state, context.cell.robot.identity.tcp_offset)
        points = board_points(context.cell.config.board)[sighting.indices]
        view = BoardView(0, "verification", flange, points, sighting.pixels)
        self._board = _BoardSeen(view, place, time.monotonic())
        return self._board

    def _model_miss_m(self) -> float:
        context, state = self._context, self._context.cell.robot.latest()
        told = flange_pose(state, context.cell.robot.identity.tcp_offset)
        modelled = forward(context.geometry.model, state.joints_rad)
        return float(np.linalg.norm(told[:3, 3] - modelled[:3, 3]))

    def _offer(
        self,
        hover: HoverPath,
        offset_covariance: Array,
        moved_m: float,
        start: Vector6,
        board: _BoardSeen,
        pointer: PointerConfig,
        words: str,
    ) -> HoverOffer:
        context, warnings = self._context, [words]
        if (age_s := time.monotonic() - board.at_s) > 5:
            warnings.append(f"the board was seen {age_s:.0f} s ago: it must not have been moved since")
        if moved_m > 0.01:
            warnings.append(f"the board lies {1000 * moved_m:.0f} mm from where it was calibrated")
        x, y = (float(v) for v in board_points(context.cell.config.board)[hover.corner][:2])
        first = hover.plan.poses[0].joints_rad
        summary = motion_preview(
            hover.check,
            start,
            purpose=f"put the tip {1000 * hover.standoff_m:.0f} mm above corner {hover.corner} "
            f"(x {1000 * x:.0f}, y {1000 * y:.0f} mm on the board)",
            plan_sha256=plan_sha256(hover.plan),
            poses=len(hover.plan.poses),
            first_move=f"{displacement(context, start, first)}, high over the corner",
            warnings=(*warnings, *motion_warnings(context)),
        )
        sigma = np.sqrt(np.diag(offset_covariance))
        return HoverOffer(
            go=summary,
            corner=hover.corner,
            corner_m=(x, y),
            standoff_m=hover.standoff_m,
            tip_m=pointer.tip_m,
            base_from_board=matrix4(hover.base_from_board),
            sigma_m=(float(sigma[0]), float(sigma[1])),
            board_moved_m=moved_m,
            pointer=words,
        )


def _mm(point: tuple[float, float, float]) -> str:
    return ", ".join(f"{1000 * v:.1f}" for v in point)


class HoverRun(Run):
    """Carries out one approval over a corner: two moves, no image, nothing recorded."""

    def __init__(self, context: SessionContext, go: MotionApproval, hover: HoverPath) -> None:
        super().__init__(context, go, hover.geometry)
        self._hover = hover

    async def _poses(self) -> None:
        context, robot = self._context, self._context.cell.robot
        for planned in self._hover.plan.poses:
            here = (await context.arm()).joints_rad
            context.store.enter(StationState.MOVING)
            try:
                await self._drive(here, planned.joints_rad, planned.name)
            except LimitError as error:
                context.store.enter(StationState.IDLE, error)
                return
            if context.requests.halt:
                return
            if self._wants_rest() and planned is not self._hover.plan.poses[-1]:
                by = context.requests.pause_by
                reason = f"Paused by {by}" if by else "Ended"
                reason += " high over the corner. Request the touch test again."
                context.store.enter(StationState.IDLE, reason, "paused")
                return
        with contextlib.suppress(NotStillError):  # what is read next is the place where it rests
            await context.stillness.settle(RestingCheck(robot.check))
        there = (await context.arm()).joints_rad
        if context.requests.halt:
            return
        reason = (
            f"The tip stands {1000 * self._hover.standoff_m:.0f} mm above corner {self._hover.corner}. "
            "Guide it down by hand only."
        )
        context.store.event(OVER_CORNER, reason, corner=self._hover.corner)
        context.store.enter(StationState.IDLE, reason, OVER_CORNER)
        _unsay_when_moved(context, there)


def _unsay_when_moved(context: SessionContext, there: Vector6) -> None:
    """The sentence is true for as long as the arm rests there."""
    store, robot = context.store, context.cell.robot

    def look() -> None:
        moved = False
        with contextlib.suppress(RobotError):
            moved = np.abs(np.subtract(robot.latest().joints_rad, there)).max() > JOGGED_RAD
        said = store.status.cause == OVER_CORNER
        if moved or not said:
            end()
        if moved and said:
            store.update(reason="", cause="")

    end = store.watch(look)


def _refused(error: CalibrationError) -> RefusedError:
    return RefusedError(error.text, code=error.code, remedy=error.remedy, **error.values)
