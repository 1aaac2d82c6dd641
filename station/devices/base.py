"""The protocols behind which real, simulated and played-back devices are equals; the thread of a driver."""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from recordings.schema.clocks import ClockFit
from recordings.schema.messages import ArmKinematics, CameraIdentity, Image, RobotIdentity, RobotState
from station.cell.acceptance import StopWay
from station.cell.errors import StaleStateError
from station.devices.frames import CameraCounts, FrameTiming, TriggerPulse

T = TypeVar("T")


class DeviceThread:
    """The one thread that calls a blocking driver, which may be stuck in it for seconds."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._pool: ThreadPoolExecutor | None = None

    def run(self, job: Callable[[], T]) -> asyncio.Future[T]:
        """Begin a job behind those that were begun before."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, self._name)
        return asyncio.get_running_loop().run_in_executor(self._pool, _letting_go, job)

    async def close(self, last: Callable[[], object]) -> None:
        """Run a last job and end the thread; nothing where it never ran."""
        if (pool := self._pool) is not None:
            self._pool = None
            await asyncio.get_running_loop().run_in_executor(pool, last)
            pool.shutdown(wait=False)


def _letting_go(job: Callable[[], T]) -> T:
    """Does it. What a failed job held is let go here: an error may be kept, and by its traceback the device.

    The end of a camera that is gone takes seconds; in the loop's thread, the arm would be without heartbeat.
    """
    try:
        return job()
    except BaseException as error:
        held: BaseException | None = error
        while held is not None:
            traceback.clear_frames(held.__traceback__)
            held = held.__cause__ or held.__context__
        raise


class ArmNews(Protocol):
    """What an arm tells of itself; how late that may come: `devices.news`."""

    guided: bool
    """A person moves the arm by hand: its news may be late by no more than those of an arm in motion."""

    def latest(self) -> RobotState:
        """Newest state; StaleStateError when older than 100 ms. For who looks again anyway; who decides waits
        for the news: `fresh`, `ready`."""

    def news(self) -> RobotState | None:
        """Newest state; None while it is late, but may still come. StaleStateError after 0.25 s in motion,
        1 s at rest."""

    def delay(self, pause_s: float, since_s: float) -> StaleStateError | None:
        """What made news late since then (host monotonic), by `devices.news`; None: nothing did.

        `pause_s`: how long this computer was busy.
        """

    def check(self) -> RobotState | None:
        """`news`; raises RobotError for what speaks against capturing now: safety stop, TCP changed."""


class Robot(ArmNews, Protocol):
    """An arm. Connecting is read-only; only `start_control` (by an approval) replaces the robot's program."""

    @property
    def identity(self) -> RobotIdentity: ...

    @property
    def control(self) -> bool:
        """The control program runs and obeys us."""

    @property
    def control_path(self) -> str:
        """Driver of the arm: ur_rtde or script; empty where nothing real moves."""

    @property
    def kinematics(self) -> ArmKinematics | None:
        """The maker's calibration of this arm, that its poses follow; None where it is not known."""

    @property
    def notice(self) -> str:
        """Notice to a person while a move is under way, though it is no fault; empty = nothing."""

    @property
    def remote(self) -> bool | None:
        """Remote control is on; None where there is no such switch or it is not known."""

    async def connect(self) -> RobotIdentity:
        """Reads identity and starts the state stream. Raises RobotError."""

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        """Every sample, in order, at the full rate, from the reader's thread: the callback must be quick."""

    def at(self, host_monotonic_ns: int) -> RobotState:
        """State interpolated at a host time within the last 10 s; StaleStateError outside."""

    def clock(self) -> ClockFit | None:
        """The controller's clock against the host's; None while not known."""

    async def start_control(self) -> None:
        """Spawns the control child. Only in answer to a motion approval. RobotError when refused."""

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Moves the joints and returns when arrived. RobotError, SafetyStopError, StaleStateError."""

    def heartbeat(self) -> None:
        """Called by the session loop at least every 50 ms while control lives; without it the arm stops."""

    @property
    def payload(self) -> tuple[float, ...]:
        """Mass (kg) and centre (m, in `flange`) as the controller tells them; empty: not told."""

    def stop_one_way(self, way: StopWay) -> None:
        """Ends the move under way by one way alone, for a stop test. RobotError where that is not there."""

    async def stop(self, reason: str) -> None:
        """Decelerates now, by both paths; idempotent, in any state, never raises."""

    async def end_control(self) -> None:
        """Stops the script and ends the child."""

    async def close(self) -> None: ...


NEWS_POLL_S = 0.005


async def fresh(robot: ArmNews) -> RobotState:
    """Where the arm is now. News that are late are waited for. StaleStateError when they do not come."""
    while (state := robot.news()) is None:
        await asyncio.sleep(NEWS_POLL_S)
    return state


async def ready(robot: ArmNews) -> RobotState:
    """`fresh`, and nothing speaks against capturing. Raises RobotError for what does."""
    while (state := robot.check()) is None:
        await asyncio.sleep(NEWS_POLL_S)
    return state


class Camera(Protocol):
    @property
    def identity(self) -> CameraIdentity: ...

    async def open(self) -> CameraIdentity:
        """Raises CameraError with the remedy."""

    async def capture(self, timeout_s: float = 5.0) -> Image:
        """One trigger, one frame, with its `time`. Raises CameraError; never returns an older frame.

        `frames.FrameClock` finds the time; a camera of another kind fills in source and bound by itself.
        """

    @property
    def timing(self) -> FrameTiming | None:
        """Accuracy of its frames' times now; None while not known. At once, from any thread."""

    def counts(self) -> CameraCounts:
        """Since it was made. At once, from any thread."""

    async def settings(self) -> dict[str, object]:
        """Settings that the camera reports now, for the recording; JSON types only. Raises CameraError.

        `region`, where it has one: x, y, width, height of its images.
        """

    async def glimpse(self) -> Image | None:
        """An image exposed after this call, of any size, that takes no number and is never recorded.

        None where there is no such thing (played images). Raises CameraError within about a second.
        """

    async def preview(self) -> Image | None:
        """A recent image for the screen; None when there is none. Never recorded."""

    async def close(self) -> None: ...


class Trigger(Protocol):
    async def open(self) -> str:
        """Identity text. Raises TriggerError."""

    @property
    def pulses(self) -> int:
        """Counted by the box since it was opened, whoever caused them."""

    async def fire(self) -> TriggerPulse: ...

    async def close(self) -> None: ...
