"""Protocols that real, simulated and played-back devices implement, and the worker thread of a driver.

Where is the arm now? `arm.state()` says it or raises. Its argument is the largest age that the state may
have; without it only the present state will do. A late state may be waited for while `arm.overdue()` has
nothing against it (the rule is in `devices.news`): `await wait_for_state(arm)` waits, `look_at(arm)` looks
once, for loops that look again soon. Both can ask `arm.check(state)`, too: may the arm be captured in it?

Where was it at an image's exposure? `arm.at(time)`.
"""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from recordings.schema.messages import ArmKinematics, CameraIdentity, Image, RobotIdentity, RobotState
from station.cell.arm_acceptance import StopWay
from station.cell.clock_fit import ClockFit
from station.cell.errors import StaleStateError
from station.cell.status import ArmCondition, CameraCounts, FrameTiming
from station.devices.news import CURRENT_S

T = TypeVar("T")


class DeviceThread:
    """Worker thread that makes all calls to a blocking driver, so that the event loop never waits for it."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._pool: ThreadPoolExecutor | None = None

    def run(self, job: Callable[[], T]) -> asyncio.Future[T]:
        """Queue a job; the future gives its result."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, self._name)
        return asyncio.get_running_loop().run_in_executor(self._pool, _run_and_release, job)

    async def close(self, last: Callable[[], object]) -> None:
        """Run a last job and end the thread; does nothing when no job was ever run."""
        if (pool := self._pool) is not None:
            self._pool = None
            await asyncio.get_running_loop().run_in_executor(pool, last)
            pool.shutdown(wait=False)


def _run_and_release(job: Callable[[], T]) -> T:
    """Run the job; on failure clear the frames of the traceback, else a stored error keeps the device open.

    Clearing happens in this thread because closing a lost camera takes seconds, and the event loop must send
    the arm's heartbeat.
    """
    try:
        return job()
    except BaseException as error:
        held: BaseException | None = error
        while held is not None:
            traceback.clear_frames(held.__traceback__)
            held = held.__cause__ or held.__context__
        raise


class Arm(Protocol):
    """An arm that tells its pose. Nothing here sends it anything that moves or stops it.

    `devices.news` defines how late the states that it reports may be.
    """

    guided: bool
    """True while a person moves the arm by hand: states may then be late by `MOVING_S` only."""

    def state(self, largest_age_s: float = CURRENT_S) -> RobotState:
        """Return the newest state, without waiting. StaleStateError where it is older than `largest_age_s`.

        Its age is the time since it arrived, by this computer's monotonic clock.
        """

    def overdue(self) -> StaleStateError | None:
        """Name why a late state is waited for no longer; None: it may still come, or it is there.

        It may come within `MOVING_S` in motion, `RESTING_S` at rest (`devices.news`).
        """

    def delay(self, pause_s: float, since_s: float) -> StaleStateError | None:
        """Name what made states late since `since_s` (host monotonic), by `devices.news`; None: nothing did.

        `pause_s`: how long this computer was busy.
        """

    def check(self, state: RobotState) -> bool:
        """Tell whether the arm may be captured in its present state; False: that is not known yet.

        RobotError where nothing may be captured, as after a safety stop or TCP change.
        """

    @property
    def identity(self) -> RobotIdentity: ...

    def condition(self, state: RobotState) -> ArmCondition:
        """Describe the arm's condition in one of its states."""

    @property
    def kinematics(self) -> ArmKinematics | None:
        """The maker's calibration of this arm, with which its poses are computed; None: unknown."""

    @property
    def notice(self) -> str:
        """Hint for people that is no fault, such as a low speed slider during a move; empty: none."""

    async def connect(self) -> RobotIdentity:
        """Read the identity and start the state stream. Raises RobotError."""

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        """Call back with every state in order: the callback must be quick."""

    def at(self, host_monotonic_ns: int) -> RobotState:
        """Interpolate the state at a host time within the last 10 s; StaleStateError outside."""

    def clock(self) -> ClockFit | None:
        """Return the controller's clock against the host's; None while not known."""

    async def close(self) -> None: ...


class Mover(Protocol):
    """The driver that moves an arm. `start_control` replaces the program that runs on the robot."""

    control_path: str
    """Driver of the arm: ur_rtde or script; empty where no real arm moves."""
    control_trouble: tuple[str, str]
    """Why this driver cannot be used, and the remedy; both empty: it can."""

    @property
    def remote(self) -> bool | None:
        """Whether remote control is on; None where there is no such switch or it is not known."""

    async def may_start(self) -> None:
        """Check that control could be started now: nobody shall approve in vain. RobotError says why not."""

    async def start_control(self) -> None:
        """Start the control process. Call only after a motion approval. RobotError when refused."""

    async def move(self, joints_rad: Sequence[float], speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Move the joints; return on arrival. Raises RobotError, SafetyStopError, StaleStateError."""

    def heartbeat(self) -> None:
        """Keep the arm's watchdog from stopping it: call at least every 50 ms while control is started."""

    @property
    def payload(self) -> tuple[float, ...]:
        """Mass (kg) and centre (m, in `flange`) reported by the controller; empty: not reported."""

    def stop_one_way(self, way: StopWay) -> None:
        """End the move by only this stop path, for a stop test. RobotError where the path is missing."""

    async def stop(self, reason: str) -> None:
        """Decelerate now, by control process and dashboard alike; idempotent, in any state, never raises."""

    def after_stop(self, state: RobotState) -> bool:
        """Tell whether a state was sampled after the newest stop had arrived at the controller.

        Only such a state can say that the arm rests: an older one may be from before a move that had just
        begun. True where no stop was sent.
        """

    async def end_control(self) -> None:
        """Stop the control program and end its process."""


STATE_POLL_S = 0.005


async def wait_for_state(arm: Arm, *, checked: bool = False) -> RobotState:
    """Wait for the present state of the arm and return it. StaleStateError when none comes (`Arm.overdue`).

    `checked`: the arm must be one that may be captured; RobotError where nothing may be (`Arm.check`).
    """
    while (state := look_at(arm, checked=checked)) is None:
        await asyncio.sleep(STATE_POLL_S)
    return state


def look_at(arm: Arm, *, checked: bool = False) -> RobotState | None:
    """Return what `wait_for_state` waits for, or None while it may still come. The same errors."""
    try:
        state = arm.state()
    except StaleStateError:
        if (overdue := arm.overdue()) is not None:
            raise overdue from None
        return None
    return state if not checked or arm.check(state) else None


class Camera(Protocol):
    """A camera: `capture` takes the images of a recording, `glimpse` those for screens."""

    @property
    def identity(self) -> CameraIdentity: ...

    async def open(self) -> CameraIdentity:
        """Open the camera and read its identity. Raises CameraError with the remedy."""

    async def capture(self, timeout_s: float = 5.0) -> Image:
        """Trigger once and return that frame with its `time`, never an older one. Raises CameraError when
        it does not come within its exposure and `timeout_s`.

        Drivers get the time from `frames.FrameClock`, or fill in source and bound themselves. The recording
        numbers it.
        """

    @property
    def timing(self) -> FrameTiming | None:
        """Accuracy of frame times now; None while not known. Does not block; from any thread."""

    def counts(self) -> CameraCounts:
        """Counts of frames since this object was made. Does not block; from any thread."""

    async def settings(self) -> dict[str, object]:
        """Read the camera's settings for the recording; JSON types only. Raises CameraError.

        `region`, where there is one: x, y, width, height of the images, pixels.
        """

    async def glimpse(self) -> Image:
        """Take an image, exposed after this call and of any size, that is not recorded.

        For screens, and to see whether something moves. Raises CameraError about a second after its exposure.
        """

    async def close(self) -> None: ...
