"""`station touch-test`: the tip over corners of the board, then a person's hand; the offsets are kept."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.text import Text

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, Touch, read_calibration
from calibrate.files.install import load_installed
from calibrate.files.verification import note_in_file, note_installed, touch_text
from calibrate.geometry import Array
from station.cell.errors import RefusedError, StationError
from station.cell.socket_folder import default_socket
from station.cell.status import HoverOffer, StationState, StationStatus
from station.cli.console import AsJson, Socket, err, out
from station.cli.session import ask_person, ctrl_c_at_once
from station.operate.attend import stop_and_say, wait_until_idle, watch_until_rest
from station.operate.touching import (
    Hovering,
    axes_words,
    read_offset_mm,
    tip_on_board_m,
    told_offset_mm,
    touch_of,
    two_numbers,
)
from station.plan.hover import outer_corners
from station.protocol.client import Client


def touch_test_command(
    calibration: Annotated[
        Path | None, typer.Argument(help="A calibration file; default: the installed one", show_default=False)
    ] = None,
    corner: Annotated[
        list[int] | None,
        typer.Option(help="Which corners (0 = the board's origin); default: the four outermost"),
    ] = None,
    standoff_mm: Annotated[
        float, typer.Option(help="How high the tip stands over the board; 61 or more")
    ] = 80.0,
    pointer_mm: Annotated[
        float | None, typer.Option(help="Length of a pointer along the flange's z axis")
    ] = None,
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Test a calibration by touching corners of the board by hand.

    The board must be in the camera's view at the start. Every move is asked for: at most 0.05 m/s, 50 mm
    and more from the board. Down to the board it goes by your hand only (free-drive on the pendant). The
    offsets are written into the calibration. Ctrl-C is STOP.

    --json: no questions, simulated cells only, nothing is written.

    Exit codes: 0 all corners were visited, 3 some were left out, 1 none.
    """
    asked = _Asked(calibration, corner, standoff_mm / 1000, None if pointer_mm is None else pointer_mm / 1000)
    visit = asyncio.run(_Visit(asked, socket or default_socket(), as_json).corners())
    if as_json:
        print(json.dumps({"calibration": visit.named, "corners": visit.rows}))
    if not visit.rows:
        raise typer.Exit(1)
    if len(visit.rows) < visit.wanted:
        raise typer.Exit(3)


@dataclass(frozen=True)
class _Asked:
    file: Path | None
    corners: list[int] | None
    standoff_m: float
    pointer_m: float | None


class _Visit:
    """Corner by corner, with one connection that holds the lease and one that watches."""

    def __init__(self, asked: _Asked, socket: Path, quiet: bool) -> None:
        self._asked, self._socket, self._quiet = asked, socket, quiet
        self.named, self.wanted = str(asked.file or "installed"), 0
        self.rows: list[dict[str, Any]] = []
        self._touches: list[Touch] = []
        self._root: Path | None = None

    async def corners(self) -> _Visit:
        async with (
            await Client.connect(self._socket) as holder,
            await Client.connect(self._socket) as watcher,
        ):
            status = await wait_until_idle(watcher)
            if self._quiet and not status.simulated:
                raise RefusedError("--json asks nobody: it is for simulated cells only. Nothing moved.")
            self._root = holder.root
            await holder.request("lease", action="take")
            self._board = self._calibration().board
            corners = self._asked.corners or outer_corners(self._board)
            self.wanted = len(corners)
            try:
                for number, corner in enumerate(corners):
                    if not await self._one(holder, watcher, corner, number == 0):
                        break
            finally:
                self._write()
        return self

    def _calibration(self) -> Calibration:
        if self._asked.file is not None:
            return read_calibration(self._asked.file)
        return load_installed(self._root, allow_simulated=True)

    async def _one(self, holder: Client, watcher: Client, corner: int, first: bool) -> bool:
        """False when the person wants no more. A corner that cannot be reached is said and left out."""
        more: dict[str, Any] = {"new_picture": first or not self.rows}
        if self._asked.file is not None:
            more["calibration"] = str(self._asked.file.resolve())
        if self._asked.pointer_m is not None:
            more["pointer_m"] = self._asked.pointer_m
        try:
            answer = await holder.request(
                "hover", corner=corner, standoff_m=self._asked.standoff_m, timeout_s=90.0, **more
            )
        except RefusedError as refused:
            if f"corner {corner}" not in str(refused):
                raise  # it would be the same at every corner
            err.print(Text.assemble((f"corner {corner} is left out", "yellow"), f": {refused}"))
            return True
        offer = msgspec.convert(answer, HoverOffer)
        if not self._quiet and not ask_person(offer.go):
            err.print("nothing moved")
            return False
        hovering = await self._hover(holder, watcher, offer)
        self.rows.append(_row(hovering))
        if self._quiet:
            return True
        return await self._ask_offset(hovering)

    async def _hover(self, holder: Client, watcher: Client, offer: HoverOffer) -> Hovering:
        """Being cancelled (Ctrl-C) sends STOP and says so."""
        await asyncio.sleep(0)  # Ctrl-C at the question strikes here, before the go is sent
        try:
            await holder.request("go", token=offer.go.token, plan_sha256=offer.go.plan_sha256)
            watcher.outdate()
            status = await watch_until_rest(watcher, lambda _: None)
        except asyncio.CancelledError:
            await stop_and_say(holder)
            raise
        if status.state is not StationState.IDLE or status.robot.base_from_flange is None:
            raise StationError(f"the hover ended {status.state.value}: {status.reason}")
        return Hovering.arrived(offer, status.robot.base_from_flange, status.reason)

    async def _ask_offset(self, hovering: Hovering) -> bool:
        offer = hovering.offer
        height = f"{1000 * abs(hovering.tip_m[2]):.0f} mm"
        err.print(
            f"The tip stands {height} above corner {offer.corner}. Guide it by hand (free-drive on the "
            "pendant). Either\n"
            "  lower it straight and type how far from the corner it lands, in mm along the board's\n"
            f"  {axes_words(self._board)}: 0.2,-0.1\n"
            "  or bring it exactly onto the corner, hold it, press Enter: the arm's position is read\n"
            "  (s: leave this corner out, q: no more corners)"
        )
        while True:
            try:
                with ctrl_c_at_once():
                    said = str(typer.prompt("offset x,y", default="", show_default=False, err=True)).strip()
            except typer.Abort:
                return False
            if said in ("s", "q"):
                return said == "s"
            try:
                if said:
                    offset, found = told_offset_mm(hovering, two_numbers(said)), "told by a person"
                else:
                    offset, found = read_offset_mm(offer, await self._tip_now(offer)), "read from the arm"
            except RefusedError as problem:
                err.print(str(problem), style="yellow")
                continue
            self._touches.append(touch := touch_of(hovering, offset, found))
            err.print(touch_text(touch))
            return True

    async def _tip_now(self, offer: HoverOffer) -> Array:
        async with await Client.connect(self._socket) as fresh:
            status: StationStatus = await wait_until_idle(fresh)
        if status.robot.base_from_flange is None:
            raise RefusedError("the robot's position is not known now")
        return tip_on_board_m(offer, status.robot.base_from_flange)

    def _write(self) -> None:
        if not self._touches:
            return
        try:
            if self._asked.file is not None:
                note_in_file(self._asked.file, self._touches)
                out.print(f"written into {self._asked.file}")
            else:
                made = note_installed(self._root, self._touches)
                out.print(f"written: generation {made.number} is installed, {made.path}")
        except (CalibrationError, OSError) as problem:
            err.print(Text.assemble(("not written", "red"), f": {problem}"))
            for touch in self._touches:
                err.print(f"  {touch_text(touch)}")


def _row(hovering: Hovering) -> dict[str, Any]:
    offer = hovering.offer
    return {
        "corner": offer.corner,
        "corner_mm": [1000 * v for v in offer.corner_m],
        "tip_mm": (1000 * hovering.tip_m).tolist(),
        "standoff_mm": 1000 * offer.standoff_m,
        "sigma_mm": [1000 * v for v in offer.sigma_m],
        "top_speed_m_s": offer.go.top_speed_m_s,
        "path_m": offer.go.path_m,
        "duration_s": offer.go.duration_s,
    }
