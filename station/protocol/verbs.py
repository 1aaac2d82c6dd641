"""Table of the daemon's verbs: each class is a request that a client may send.

Its fields are the arguments, its type parameter the result, its docstring the line of help; `states` says in
which states it is allowed, `control` whether only the client that has control may ask, `needs` who must stand
behind the client where the station moves a real arm. Dispatch, client, `--json` and
docs/reference/protocol.md follow from it.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar, get_args

import msgspec

from recordings.schema.messages import BoardSpec, Matrix4
from station.cell.arm_acceptance import StopWay
from station.cell.config import StationConfig
from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan
from station.cell.status import MotionPreview
from station.cell.status import StationState as S
from station.protocol.states import LATCHED, RESTING, RUNNING

R = TypeVar("R", covariant=True)
_ANY = frozenset(S)
_LOADING = frozenset({S.IDLE, S.DISCONNECTED})
_AT_REST = _ANY - RUNNING


class Needs(StrEnum):
    """Who must stand behind a client, beside control, where the station moves a real arm.

    The kernel tells who does (`server.approval`); what a client says of itself does not count.
    """

    NOBODY = ""
    """Every member of the socket's group may ask."""
    PERSON = "a person at a terminal"
    """Also the person at the operator screen."""
    PERSON_OR_SERVICE = "a person at a terminal, or a service with the hash while no latch is held"


class Verb(msgspec.Struct, Generic[R], frozen=True, forbid_unknown_fields=True):
    """A request with its arguments; `R`: the type of its result."""

    states: ClassVar[frozenset[S]] = _ANY
    control: ClassVar[bool] = True
    needs: ClassVar[Needs] = Needs.NOBODY
    moves: ClassVar[bool] = False
    """For arms that the station moves only."""
    spoken: ClassVar[str] = ""
    """What the operator wants by it, as in "… is not possible now"; empty: the verb's name says it."""
    wire: ClassVar[str] = ""
    """Name in messages; empty: derived from the class's (`LoadPlan`: load_plan)."""

    @classmethod
    def verb(cls) -> str:
        return cls.wire or re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    @classmethod
    def result(cls) -> Any:
        """Type of the verb's result."""
        return get_args(cls.__orig_bases__[0])[0]  # type: ignore[attr-defined]

    @classmethod
    def help(cls) -> str:
        return (cls.__doc__ or "").split("\n")[0]

    @classmethod
    def require(cls, state: S) -> None:
        """Raise RefusedError where the verb is not allowed in a state."""
        if (refusal := cls.refusal(state)) is not None:
            raise refusal

    @classmethod
    def refusal(cls, state: S) -> RefusedError | None:
        """Make the error where the verb is not allowed in a state; None where it is."""
        if state in cls.states:
            return None
        why, remedy = _NOT_NOW.get(state, (f"the session is {state.value}", "Pause or stop it first."))
        return cls.refused_because(state, why, remedy)

    @classmethod
    def refused_because(cls, state: S, why: str, remedy: str) -> RefusedError:
        """Make the error of a verb that is not possible in a state, for the reason that is given."""
        return RefusedError(
            "wrong-state",
            what=cls.spoken or cls.verb().replace("_", " "),
            why=why,
            advice=remedy,
            verb=cls.verb(),
            state=state.value,
        )


_NOT_NOW: dict[S, tuple[str, str]] = {
    S.DISCONNECTED: ("the robot is not connected", "`station doctor` says why."),
    S.STOPPED: ("STOP is latched", "Look at the cell, then acknowledge."),
    S.FAULT: ("there is a fault", "Read it, look at the cell, then acknowledge."),
    S.SEALING: ("the recording is being finished", "Wait a moment."),
    S.IDLE: ("no session is running", ""),
    S.PAUSED: ("the session is paused", ""),
    S.FREE_DRIVE: ("the arm is in freedrive", "End it first."),
}


class Done(msgspec.Struct, frozen=True):
    """Empty result."""


class Welcome(msgspec.Struct, frozen=True):
    client_id: int
    """Number of this connection, by which the lease names it."""
    root: str
    """Folder of sessions and installed calibrations."""
    config: StationConfig
    """The cell as it is configured."""


class LoadedPlan(msgspec.Struct, frozen=True, omit_defaults=True):
    plan: Plan | None = None
    """The loaded plan; None: there is none."""


class PreviewImage(msgspec.Struct, frozen=True, omit_defaults=True):
    jpeg_base64: str = ""
    """JPEG in base64; empty: there is no image."""
    width: int = 0
    height: int = 0
    corners: tuple[tuple[float, float], ...] = ()
    """The board's corners, as shares of the image's sides."""
    sequence: int = 0
    age_s: float = 0.0
    """Age of the image, and of what was seen in it, when this was answered; no corners from 2 s on."""


class Observation(msgspec.Struct, frozen=True, omit_defaults=True):
    """Detection of a tag in an image, and the arm's pose at mid-exposure."""

    base_from_flange: Matrix4
    corners: tuple[int, ...] = ()
    """Rows of `calibrate.boards.model.board_points` that were found."""
    pixels: tuple[tuple[float, float], ...] = ()


class Check(msgspec.Struct, frozen=True):
    """One line of the preflight check."""

    name: str
    state: Literal["ok", "warning", "failed", "skipped"]
    text: str
    remedy: str = ""


class ResultData(msgspec.Struct, frozen=True, omit_defaults=True):
    result: Any = None
    """A `Result` of `station.protocol.results`, as plain data; None: there is none yet."""


class SessionsData(msgspec.Struct, frozen=True):
    sessions: list[Any]
    """`Kept` of `station.protocol.results`, as plain data, newest first."""


class InstalledVersion(msgspec.Struct, frozen=True):
    version: int
    validity: str
    """valid, unverified, in-doubt, withdrawn"""


class TouchesNoted(msgspec.Struct, frozen=True, omit_defaults=True):
    file: str = ""
    """Calibration file into which they were written; empty: an installed version, which never changes."""
    version: int | None = None
    """New installed version that has them; None: another calibration is installed by now."""


PLANNED_ELSEWHERE = "planned-elsewhere"
"""Error code of a plan of which only the path from the arm's posture to the first pose is not free."""


class Purpose(StrEnum):
    """Purpose of a motion that is to be approved."""

    RUN = "run"
    DRIFT_CHECK = "check"
    RESUME = "resume"


class Hello(Verb[Welcome], frozen=True):
    """Ask for the number of this connection, and for the cell."""

    control = False


class Watch(Verb[Done], frozen=True):
    """Send the whole status now, then every change."""

    control = False


class Release(Verb[Done], frozen=True):
    """Release control, which the first request that needs it takes; the arm decelerates."""

    control = False
    silent: bool = False
    """The screen releases it, as its person's terminal does not answer."""


class Stop(Verb[Done], frozen=True):
    """Stop the arm now, from any client.

    `server.connections` carries it out before any limit and later line: `server.dispatch` has no case of it.
    """

    control = False


class Acknowledge(Verb[Done], frozen=True):
    """Leave `stopped` or `fault` after a person looked, and let services approve motion again.

    After a lost connection the station rests and is not latched: there it only lets services approve again.
    """

    states = LATCHED | RESTING | {S.DISCONNECTED}
    control = False
    needs = Needs.PERSON
    cause: str = ""
    """Of the state that was seen, of which alone it is; empty: of whatever stands."""


class GetPlan(Verb[LoadedPlan], frozen=True):
    """Return the loaded plan."""

    wire = "plan"
    control = False


class LoadPlan(Verb[Done], frozen=True):
    """Load a plan. `prepare` checks the whole of it, from where the arm is then."""

    states = _LOADING
    moves = True
    spoken = "another plan"
    plan: Plan | None = None
    """None: the one that the last loaded one replaced, with what became of its poses."""


class MakePlan(Verb[Done], frozen=True):
    """Make a plan in a worker process and load it."""

    states = _LOADING
    moves = True
    spoken = "a new plan"
    poses: Annotated[int, msgspec.Meta(ge=4, le=200)] = 25
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    lens_known: bool = False
    aim: Literal["camera", "arm"] = "camera"
    """What the poses should determine: the camera pose, or the arm's table, too."""


class StopTest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A slow, short move of one joint that is ended in one way."""

    way: StopWay
    speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=0.25)]
    """Speed of the fastest modelled point."""
    joint: Annotated[int, msgspec.Meta(ge=0, le=5)] = 0
    forward: bool = True
    """Direction that is tried first."""


class Prepare(Verb[MotionPreview], frozen=True):
    """Check the whole path from where the arm is and offer its approval; a stop test only to a person."""

    states = RESTING
    moves = True
    spoken = "a motion"
    purpose: Purpose = Purpose.RUN
    stop_test: StopTest | None = None
    """The move of a stop test; None: poses at which images are captured."""


class Go(Verb[Done], frozen=True):
    """Approve exactly the motion that was offered, once; a stop test is approved by a person only."""

    states = RESTING
    needs = Needs.PERSON_OR_SERVICE
    moves = True
    spoken = "starting a motion"
    token: str
    approval_sha256: str = ""


class Pause(Verb[Done], frozen=True):
    """Pause after this pose."""

    states = RUNNING
    control = False


class Finish(Verb[Done], frozen=True):
    """Finish the recording with what is there; a pose under way is taken first."""

    states = RUNNING | {S.PAUSED, S.FREE_DRIVE}


class Retake(Verb[Done], frozen=True):
    """Plan a pose once more."""

    states = RUNNING | RESTING
    moves = True
    spoken = "taking a pose again"
    index: int


class Skip(Verb[Done], frozen=True):
    """Leave a pose out; in freedrive: take back its image."""

    states = RUNNING | RESTING | {S.FREE_DRIVE}
    spoken = "leaving a pose out"
    index: int


class Freedrive(Verb[Done], frozen=True):
    """Begin or end capture by hand."""

    wire = "free_drive"
    spoken = "capture by hand"
    states = RESTING | {S.FREE_DRIVE}
    on: bool
    check: bool = False
    """A session that begins is a drift check."""


class Record(Verb[Done], frozen=True):
    """Capture here and now (freedrive)."""

    states = frozenset({S.FREE_DRIVE})


class Preview(Verb[PreviewImage], frozen=True):
    """Return the newest image that fits into width × height, px."""

    control = False
    width: int = 480
    height: int = 384


class Observe(Verb[Observation], frozen=True):
    """Look for a tag in a new image between sessions, while the arm rests. Nothing is kept."""

    states = frozenset({S.IDLE})
    control = False
    spoken = "a look at the tag"
    tag: BoardSpec


class Doctor(Verb[list[Check]], frozen=True):
    """Run the preflight check."""

    control = False


class GetResult(Verb[ResultData], frozen=True):
    """Return the calibration made from a session, beside what is installed.

    Without a session it is that of the one just recorded. Before any, and after a drift check, it is that of
    what is installed.
    """

    wire = "result"
    control = False
    session: str = ""
    """Name of the session, which is that of its folder."""


class GetSessions(Verb[SessionsData], frozen=True):
    """Return the recorded sessions and what became of each, newest first."""

    wire = "sessions"
    control = False


class GetInstalled(Verb[InstalledVersion], frozen=True):
    """Return the installed version, once its file was read; an error where there is none or it is damaged."""

    wire = "installed"
    control = False


class Install(Verb[InstalledVersion], frozen=True):
    """Make the calibration of a session the installed one; with a reason to override only by a person."""

    states = _AT_REST
    spoken = "installing"
    session: str
    """Empty: the installed version itself, once more."""
    override: str = ""
    """A person's reason to install in spite of a refusal, kept in the file."""


class Rollback(Verb[InstalledVersion], frozen=True):
    """Make the calibration before the installed one the installed one again."""

    states = _AT_REST
    spoken = "going back to the calibration before"
    seen: int
    """Version that the person saw installed; refused where it is another one by now."""


class Withdraw(Verb[InstalledVersion], frozen=True):
    """Take the installed calibration out of use."""

    reason: str
    """Why it must not be used; kept, and told to programs."""
    seen: int
    """Version that the person saw installed; refused where it is another one by now."""


class NoteTouches(Verb[TouchesNoted], frozen=True):
    """Write touch tests into the calibration of a session, and into the installed one of the same solve."""

    states = _AT_REST
    spoken = "writing touch tests"
    session: str
    """Empty: into the installed version."""
    touches: list[Any]
    """Each as `verification` in a calibration file."""


class Quit(Verb[Done], frozen=True):
    """End a daemon that its user started by hand, once its session is finished and nothing is latched."""

    states = RESTING | {S.DISCONNECTED}
    spoken = "ending the station"


VERBS: dict[str, type[Verb[object]]] = {kind.verb(): kind for kind in Verb.__subclasses__()}
