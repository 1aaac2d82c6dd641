"""A link without a daemon: records what the screen asks, shows it the statuses a test wants."""

from __future__ import annotations

import asyncio
import base64
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from textual.pilot import Pilot

from station.cell.status import (
    CameraStatus,
    MotionPreview,
    PoseStatus,
    RobotStatus,
    SessionStatus,
    StationState,
    StationStatus,
)

SUMMARY = MotionPreview(
    token="t-1",
    purpose="run plan",
    plan_sha256="ab" * 32,
    poses=25,
    path_m=4.2,
    largest_step_rad=0.7,
    top_speed_m_s=0.22,
    duration_s=95.0,
    first_move="84 mm and 22° to pose 1",
)


UNTIL_S = 40.0


async def until(pilot: Pilot[None], condition: Callable[[], object]) -> None:
    """What the screen comes to, however busy the computer is."""
    give_up_s = time.monotonic() + UNTIL_S
    while not condition():
        assert time.monotonic() < give_up_s, "it did not come to that"
        await pilot.pause(0.02)


class FakeLink:
    """Answers like a daemon in a good mood; `refuse` maps verbs to errors."""

    root: Path | None = None

    def __init__(self) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self.refuse: dict[str, Exception] = {}
        self.answers: dict[str, Any] = {
            "prepare": SUMMARY,
            "preview": _picture(),
            "lease": {"holder": "me", "client_id": 7},
            "sessions": [{"name": "s-0"}],
        }
        self.silent = asyncio.Event()
        """While set nothing is answered, as by a daemon that hangs."""
        self._statuses: asyncio.Queue[StationStatus | None] = asyncio.Queue()
        self.show(idle())

    def show(self, status: StationStatus | None) -> None:
        """The next status; None = the daemon dies."""
        self._statuses.put_nowait(status)

    @property
    def verbs(self) -> list[str]:
        return [verb for verb, _ in self.asked if verb not in ("preview", "sessions", "watch")]

    async def request(self, verb: str, **args: Any) -> Any:
        self.asked.append((verb, args))
        while self.silent.is_set():
            await asyncio.sleep(0.01)
        if verb in self.refuse:
            raise self.refuse[verb]
        return self.answers.get(verb, {})

    async def statuses(self) -> AsyncIterator[StationStatus]:
        while (status := await self._statuses.get()) is not None:
            yield status

    async def close(self) -> None:
        self.show(None)


def _picture() -> dict[str, Any]:
    board = np.kron(np.indices((6, 8)).sum(axis=0) % 2, np.ones((16, 16))).astype(np.uint8) * 255
    data = cv2.imencode(".jpg", board)[1].tobytes()
    return {"jpeg_base64": base64.b64encode(data).decode(), "corners": [[0.25, 0.25], [0.5, 0.5]]}


def idle(state: StationState = StationState.IDLE, reason: str = "") -> StationStatus:
    poses = tuple(PoseStatus(index=i, name=f"p{i + 1:02d}", why="tilted left") for i in range(25))
    return StationStatus(
        state=state,
        reason=reason,
        simulated=True,
        robot=RobotStatus(connected=True, model="UR10", safety="NORMAL", remote=True, rate_hz=125.0),
        camera=CameraStatus(connected=True, model="MER-131-75GM", width=1280, height=1024),
        session=SessionStatus(name="s-1", poses=poses, plan_sha256="ab" * 32),
    )


@pytest.fixture
def link() -> FakeLink:
    return FakeLink()
