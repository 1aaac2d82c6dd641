"""What is installed and what was recorded, as the daemon tells it to its screens.

The verbs carry these as plain data: this module knows the calibration file, and so needs NumPy, which
`station stop` and every other command that only asks do without.
"""

from __future__ import annotations

import msgspec

from calibrate.check.history import CheckEntry
from calibrate.files.calibration import Calibration, Override, Verdict
from calibrate.files.validity import Validity, ValidityState
from calibrate.files.versions import LogEntry, same_solve
from station.cell.session_folder import SessionSummary


class InstalledBefore(msgspec.Struct, frozen=True, omit_defaults=True):
    """The version that an undo goes back to."""

    version: int
    session: str
    created: str
    """Time of its solve, UTC."""
    override: Override | None = None


class Installed(msgspec.Struct, frozen=True, omit_defaults=True):
    """What is and was installed for one camera; calibrations without `posterior`, which no screen shows."""

    now: Calibration | None = None
    """What programs read; None when there is nothing, or it is damaged."""
    version: int | None = None
    """The installed version, also where its file is damaged; None: nothing is installed."""
    validity: Validity | None = None
    """Whether `now` still holds."""
    before: InstalledBefore | None = None
    """None: an undo goes back to nothing, so that `now` can only be taken out of use."""
    drift: tuple[CheckEntry, ...] = ()
    """Drift checks of `now`, oldest first."""
    last: LogEntry | None = None
    """The last installation."""

    @property
    def held(self) -> str:
        """INSTALLED, and its validity where that is not valid; WITHDRAWN: programs are refused it."""
        if self.withdrawn:
            return "WITHDRAWN"
        if self.validity is None or self.validity.state is ValidityState.VALID:
            return "INSTALLED"
        return f"INSTALLED, {self.validity.state.replace('-', ' ')}"

    @property
    def doubted(self) -> bool:
        """`now` is in doubt, or withdrawn."""
        doubts = ValidityState.IN_DOUBT, ValidityState.WITHDRAWN
        return self.validity is not None and self.validity.state in doubts

    @property
    def withdrawn(self) -> bool:
        """A person took `now` out of use."""
        return self.validity is not None and self.validity.state is ValidityState.WITHDRAWN


class Result(msgspec.Struct, frozen=True, omit_defaults=True):
    """A calibration file, beside what is installed."""

    path: str
    calibration: Calibration | None = None
    """Without `posterior`. None: the file cannot be read, and `problem`."""
    state: Installed = Installed()
    objections: tuple[str, ...] = ()
    """What installing would ask a reason for, besides failed gates; none where it is installed."""
    problem: str = ""
    session: str = ""
    """Name of the session in whose folder it lies; empty: it is the installed version itself."""
    installed_before: bool = False
    """It was installed, and another one is now."""
    report: str = ""
    """Path of its report; empty: there is none."""

    @property
    def installed(self) -> bool:
        return self.calibration is not None and same_solve(self.calibration, self.state.now)

    @property
    def became(self) -> str:
        """State of a calibration that is or was installed; else empty."""
        if self.installed:
            return self.state.held
        return "installed before" if self.installed_before else ""

    @property
    def withdrawn(self) -> bool:
        """It was installed, and a person took it out of use."""
        return self.installed and self.state.withdrawn

    @property
    def taken(self) -> Override | None:
        """A person's decision by which it is installed although something speaks against it."""
        return self.state.now.override if self.installed and self.state.now else None

    @property
    def verdict(self) -> Verdict:
        """PASS WITH A REASON also where all gates pass, but installing needed a reason, or would."""
        if self.calibration is None:
            return "FAIL"
        verdict = self.calibration.verdict
        return "PASS WITH A REASON" if verdict == "PASS" and (self.taken or self.objections) else verdict


class Kept(msgspec.Struct, frozen=True, omit_defaults=True):
    """A recorded session and what became of it."""

    session: SessionSummary
    verdict: Verdict | None = None
    """Of its calibration, as Result says it; None: not solved, or damaged."""
    word: str = ""
    """Its calibration is or was installed; else empty."""
    error: tuple[str, str] = ("", "")
    """Its placed-point error, and what that is of; empty without a calibration."""
    check: CheckEntry | None = None
    """The verdict of the drift check that it was recorded for."""
