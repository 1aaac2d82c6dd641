"""A link without a daemon: records what the screen asks, shows it the statuses a test wants."""

from __future__ import annotations

import asyncio
import base64
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from textual.app import App
from textual.pilot import Pilot
from textual.widgets import Static

from recordings.errors import CodedError
from recordings.schema.messages import CameraIdentity, CameraModel, RobotIdentity
from station.cell.config import (
    PAPER_BOARD,
    CameraConfig,
    LimitsConfig,
    PoseGuess,
    RobotConfig,
    StationConfig,
)
from station.cell.errors import RefusedError
from station.cell.status import (
    ArmCondition,
    CameraStatus,
    LeaseStatus,
    MotionPreview,
    PoseStatus,
    RobotStatus,
    SessionStatus,
    StationState,
    StationStatus,
)
from station.protocol.client import Client
from station.protocol.verbs import (
    VERBS,
    Doctor,
    Done,
    GetInstalled,
    GetResult,
    GetSessions,
    Install,
    NoteTouches,
    Preview,
    PreviewImage,
    Rollback,
    Verb,
    Watch,
    Withdraw,
)
from station.session.context import StatusStore
from station.session.results import Results
from station.simulation.cells import TABLE
from station.tui.app import StationApp
from tests.patience import PATIENCE_S
from tests.recordings.small_recording import make_state
from tests.station.session_rig import WorkerInThisProcess

SUMMARY = MotionPreview(
    token="t-1",
    purpose="run plan",
    approval_sha256="ab" * 32,
    poses=25,
    path_m=4.2,
    largest_step_rad=0.7,
    top_speed_m_s=0.22,
    duration_s=95.0,
    first_move="84 mm and 22° to pose 1",
)


CELL = StationConfig(
    robot=RobotConfig(model="UR10"),
    camera=CameraConfig(
        driver="rendered",
        model=CameraModel(1280, 1024, ((1400.0, 0.0, 640.0), (0.0, 1400.0, 512.0), (0.0, 0.0, 1.0))),
        model_is_rough=True,
    ),
    board=PAPER_BOARD,
    camera_guess=PoseGuess((0.0, 0.08, 0.05), (0.0, 0.0, 0.0, 1.0), 0.01, 0.05),
    board_guess=PoseGuess((0.6, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.01, 0.05),
    limits=LimitsConfig(planes=(TABLE,)),
)
"""A UR10 on a table, a camera on its flange, the board before it."""


async def until(pilot: Pilot[None], condition: Callable[[], object]) -> None:
    """Wait until the condition holds, while the screen goes on."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up_s, "it did not come to that"
        await pilot.pause(0.02)


LOOKS = (Preview, Watch, Doctor, GetResult, GetSessions, GetInstalled)
"""Verbs by which a screen only looks."""
ON_RESULTS = (GetResult, GetSessions, GetInstalled, Install, Rollback, Withdraw, NoteTouches)


class FakeLink(Client):
    """Answers like a daemon in a good mood; `refuse` maps verbs to errors."""

    def __init__(self) -> None:
        super().__init__(Path("/nowhere/control.sock"))
        self.own_id, self.root, self.config = 7, Path("/nowhere"), CELL
        self.asked: list[Verb[Any]] = []
        self.refuse: dict[str, Exception] = {}
        self.answers: dict[str, Any] = {"prepare": SUMMARY, "preview": _image()}
        self.silent = asyncio.Event()
        """While set nothing is answered, as by a daemon that hangs."""
        self.slow: dict[str, asyncio.Event] = {}
        """By the name of a verb: what its answer waits for."""
        self.same_image, self._images = False, 0
        self._serves = False
        self._results: Results | None = None
        self._looking: asyncio.Task[None] | None = None
        self._root: Path | None = None
        """The one below which `_results` are."""
        self._store = StatusStore(idle())
        self._store.watch(self._told)
        self._told()

    def show(self, status: StationStatus | None) -> None:
        """The next status, but for what is installed; None = the daemon dies."""
        if status is not None:
            fields = msgspec.structs.asdict(status)
            self._store.update(**fields | {"results": self._store.status.results})
            self._told()
            return
        self._plain_status = None
        self._serves = False
        self._tell()

    def _told(self) -> None:
        self._plain_status = msgspec.to_builtins(self._store.status)
        self._tell()

    def _below_root(self) -> Results:
        """The daemon's own door to the results below `root`, which looks twenty times a second."""
        if self._results is None or self._root is not self.root:
            self._root = self.root
            config = self.config or CELL
            self._results = Results(config, "simulated", self.root, self._store, WorkerInThisProcess())
            self._looking = asyncio.create_task(self._look(self._results))
        return self._results

    async def _look(self, results: Results) -> None:
        while self._serves and results is self._results:
            await results.look()
            await asyncio.sleep(0.05)

    async def _result(self, verb: Verb[Any]) -> object:
        """Answer a verb on results as the daemon does; None: it is another verb."""
        results = self._below_root()
        match verb:
            case GetResult():
                return await results.result(verb.session)
            case GetSessions():
                return await results.sessions()
            case GetInstalled():
                return await results.installed()
            case Install():
                return await results.install(verb, "anna")
            case Rollback():
                return await results.rollback(verb, "anna")
            case Withdraw():
                return await results.withdraw(verb, "anna")
            case NoteTouches():
                return await results.note_touches(verb, "anna")
        return None

    async def open(self) -> Client:
        if self._plain_status is None:
            raise ConnectionRefusedError("no daemon")
        self._serves = True
        return self

    @property
    def connected(self) -> bool:
        return self._serves

    @property
    def verbs(self) -> list[str]:
        return [verb.verb() for verb in self.asked if not isinstance(verb, LOOKS)]

    async def request(self, verb: str, *, timeout_s: float = 0.0, **args: object) -> object:
        asked = msgspec.convert(args, VERBS[verb])
        self.asked.append(asked)
        while self.silent.is_set():
            await asyncio.sleep(0.01)
        if verb in self.slow:
            await self.slow[verb].wait()
        if verb in self.refuse:
            raise self.refuse[verb]
        answer = self.answers.get(verb, Done())
        if isinstance(asked, ON_RESULTS) and verb not in self.answers:
            try:
                answer = await self._result(asked)
            except CodedError as error:
                raise RefusedError.from_data(error.data) from None
        if verb == "preview":
            self._images += not self.same_image
            answer = msgspec.structs.replace(answer, sequence=self._images)
        return msgspec.to_builtins(answer)

    async def close(self) -> None:
        self._serves = False


def _image() -> PreviewImage:
    board = np.kron(np.indices((6, 8)).sum(axis=0) % 2, np.ones((16, 16))).astype(np.uint8) * 255
    data = cv2.imencode(".jpg", board)[1].tobytes()
    return PreviewImage(base64.b64encode(data).decode(), 128, 96, ((0.25, 0.25), (0.5, 0.5)))


def idle(state: StationState = StationState.IDLE, reason: str = "") -> StationStatus:
    poses = tuple(PoseStatus(index=i, name=f"p{i + 1:02d}", why="tilted left") for i in range(25))
    return StationStatus(
        state=state,
        reason=reason,
        source="simulated",
        robot=RobotStatus(RobotIdentity("UR10"), make_state(0), ArmCondition(safety="NORMAL"), remote=True),
        camera=CameraStatus(CameraIdentity(model="MER-131-75GM")),
        session=SessionStatus(name="s-1", poses=poses),
    )


def in_session(status: StationStatus, **changes: object) -> StationStatus:
    """The status with fields of its session replaced."""
    return msgspec.structs.replace(status, session=msgspec.structs.replace(status.session, **changes))


def after_check(status: StationStatus, **changes: object) -> StationStatus:
    """The status after a drift check that was recorded as s-2."""
    check = SessionStatus(name="s-2", folder="/s-2", recording="/s-2/session.mcap", captured=8, check=True)
    return msgspec.structs.replace(status, checked=msgspec.structs.replace(check, **changes))


def with_robot(status: StationStatus, **changes: object) -> StationStatus:
    """The status with fields of its robot replaced."""
    return msgspec.structs.replace(status, robot=msgspec.structs.replace(status.robot, **changes))


def commanded(state: StationState, client_id: int = 7) -> StationStatus:
    """The screen of `FakeLink` is client 7."""
    return msgspec.structs.replace(idle(state), lease=LeaseStatus("anna on tty1", client_id))


def said(pilot: Pilot[None]) -> str:
    """What the notices on the screen say."""
    return " ".join(notice.message for notice in pilot.app._notifications)


@pytest.fixture
def link() -> FakeLink:
    return FakeLink()


def app_on(link: FakeLink) -> StationApp:
    return StationApp(link)


@asynccontextmanager
async def opened(
    link: FakeLink, size: tuple[int, int] = (80, 24), notifications: bool = False
) -> AsyncIterator[Pilot[None]]:
    """A screen that shows the link's simulated cell."""
    async with app_on(link).run_test(size=size, notifications=notifications) as pilot:
        await until(pilot, lambda: "SIMULATED" in text_of(pilot.app, "#bar"))
        yield pilot


def text_of(app: App[None], selector: str) -> str:
    return str(app.screen.query_one(selector, Static).render())
