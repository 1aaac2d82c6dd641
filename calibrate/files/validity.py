"""Validity of an installed calibration: valid, unverified, in doubt or withdrawn; since when, and why.

Needs only the standard library, because programs that use the camera load it too (`loader`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Any

from calibrate.errors import InstallError

NO_RECORD = "no-record"
"""Code of the reason where the log has no line of a version."""
LOG_DAMAGED = "log-damaged"
"""Code of the reason where a damaged line of the log may have withdrawn a version."""
LONGEST_AGE_DAYS = 36_500
"""A longer limit of the last proof's age is a slip."""
WITHDRAWN_REMEDY = (
    "Solve a new recording and run `calibrate install FILE`, "
    "or `calibrate rollback NUMBER` to another version of `calibrate list`"
)
LOG_DAMAGED_REMEDY = (
    "Ask whoever is in charge of the cell whether version {version} was withdrawn. If it was not, run "
    '`calibrate rollback {version} --override "REASON"`. Else solve a new recording and install it'
)


class ValidityState(StrEnum):
    VALID = "valid"
    UNVERIFIED = "unverified"
    """Nothing contradicts it, but no check has passed since it was installed or rolled back to."""
    IN_DOUBT = "in-doubt"
    """A check contradicts it, robot or camera differ, or the last proof is too old."""
    WITHDRAWN = "withdrawn"
    """A person took it out of use."""


@dataclass(frozen=True)
class ValidityReason:
    """Cause of a validity state."""

    code: str
    """installed, override, imported, rolled-back, no-record, drift-check, touch-test, robot-changed,
    camera-changed, too-old, log-damaged, withdrawn; more may come."""
    text: str = ""
    """Figures and what to do, for people."""
    values: dict[str, str | float | int | bool | None] = field(default_factory=dict)
    """Measured figures and limits; each name ends in its unit."""


@dataclass(frozen=True)
class Validity:
    """Validity of one installed version. Times are UTC in ISO format."""

    version: int
    state: ValidityState
    since: str
    reason: ValidityReason
    who: str = ""
    verified: str = ""
    """Time of the last proof: the views it was solved from, or a check that passed."""
    max_age_days: float | None = None
    """Age of the last proof from which it is in doubt; None: no limit."""

    def at(self, now: datetime) -> Validity:
        """Return the validity at a time: in doubt once the last proof is older than `max_age_days`.

        A last proof in the future, or at an unknown time, counts as too old.
        """
        said_already = self.state in (ValidityState.IN_DOUBT, ValidityState.WITHDRAWN)
        if self.max_age_days is None or said_already:
            return self
        proven = self._proven(now)
        if proven is None:
            dated = parse_time(self.verified)
            text = "The time of the last proof is not known"
            if dated is not None:
                text = (
                    f"The last proof is dated {_shown(self.verified)}, which is yet to come; check the clock"
                )
            return self._too_old(text, None, "")
        age_days = (now - proven) / timedelta(days=1)
        if age_days <= self.max_age_days:
            return self
        due = time_text(proven + timedelta(days=self.max_age_days))
        return self._too_old(f"The last proof is {age_days:.1f} days old", round(age_days, 3), due)

    def _too_old(self, text: str, age_days: float | None, since: str) -> Validity:
        said = f"{text} (limit {self.max_age_days:g} days). Run a drift check."
        values: dict[str, str | float | int | bool | None] = {
            "age_days": age_days,
            "limit_days": self.max_age_days,
        }
        reason = ValidityReason("too-old", said, values)
        return replace(self, state=ValidityState.IN_DOUBT, since=since, reason=reason)

    def after_check(
        self, reason: ValidityReason, passed: bool, proves: bool, when: datetime, who: str
    ) -> Validity:
        """Return the validity after a check on views taken at `when`; the kind of check is `reason.code`.

        `proves`: a pass had enough power, or a failure could tell a camera's shift from other errors. Then a
        failure puts it in doubt and a pass makes it valid. Otherwise a failure makes it unverified, unless it
        is in doubt already. A pass then ends a doubt of the same kind of check; any other doubt becomes
        unverified. Views from before the last proof change nothing. No check restores a version that was
        withdrawn, or that a damaged line of the log may have withdrawn.
        """
        proven = self._proven(datetime.now(UTC))
        if self.for_a_person or (proven is not None and when < proven):
            return self
        doubted = self.state is ValidityState.IN_DOUBT
        changed = replace(self, reason=reason, who=who)
        if not passed and not proves:
            return self if doubted else replace(changed, state=ValidityState.UNVERIFIED)
        if not passed:
            since = self.since if doubted else time_text(when)
            return replace(changed, state=ValidityState.IN_DOUBT, since=since)
        if proves or (doubted and self.reason.code == reason.code):
            since = self.since if self.state is ValidityState.VALID else time_text(when)
            return replace(changed, state=ValidityState.VALID, since=since, verified=time_text(when))
        return replace(changed, state=ValidityState.UNVERIFIED) if doubted else self

    @property
    def for_a_person(self) -> bool:
        """Tell whether only a person brings it back, no check: it was withdrawn, or may have been."""
        return self.state is ValidityState.WITHDRAWN or self.reason.code == LOG_DAMAGED

    @property
    def remedy(self) -> str:
        """What makes it usable again; one that is valid needs nothing of it."""
        if self.state is ValidityState.WITHDRAWN:
            return WITHDRAWN_REMEDY
        if self.reason.code == LOG_DAMAGED:
            return LOG_DAMAGED_REMEDY.format(version=self.version)
        return "Run `station drift-check`, or calibrate again"

    def _proven(self, now: datetime) -> datetime | None:
        """Time of the last proof; None where it is unknown, as with a clock that was ahead."""
        proven = parse_time(self.verified)
        return None if proven is None or proven > now else proven


_REFUSED = {
    ValidityState.IN_DOUBT: "calibration-in-doubt",
    ValidityState.WITHDRAWN: "calibration-withdrawn",
    ValidityState.UNVERIFIED: "calibration-unverified",
}


def require_usable(
    validity: Validity, what: str, anyway: str, *, proven: bool = False, camera: str = ""
) -> None:
    """Raise InstallError (code `calibration-STATE`) for one in doubt or withdrawn; `proven`: or unverified.

    `what`: subject of the message; `anyway`: how to use it all the same, for the remedy.
    """
    state = validity.state
    if state not in _REFUSED or (state is ValidityState.UNVERIFIED and not proven):
        return
    raise InstallError(
        _REFUSED[state],
        what=what,
        held=validity_text(validity).rstrip("."),
        advice=validity.remedy,
        anyway=anyway,
        version=validity.version,
        since=validity.since,
        reason=validity.reason.code,
        camera=camera,
    )


def validity_text(validity: Validity) -> str:
    """Write 'in doubt since 2026-11-22 04:50 UTC: FAIL: camera shift 3.02 mm …'."""
    words = validity.state.replace("-", " ")
    if validity.state is ValidityState.VALID:
        return f"{words}, verified {_shown(validity.verified)}"
    by = f" by {validity.who}" if validity.state is ValidityState.WITHDRAWN and validity.who else ""
    why = f": {validity.reason.text}" if validity.reason.text else ""
    return f"{words} since {_shown(validity.since)}{by}{why}"


def parse_validity(plain: dict[str, Any]) -> Validity | None:
    """Parse what a line of the log says of its version. None for another shape.

    What a later version of the software adds is left out. `Validity.at` gives the state now.
    """
    try:
        reason = ValidityReason(**_chosen(plain["reason"], _REASON_KEYS))
        named = {"state": ValidityState(plain["state"]), "reason": reason}
        found = Validity(**_chosen(plain, _VALIDITY_KEYS) | named)
        texts = found.since, found.who, found.verified, reason.code, reason.text
        shaped = type(found.version) is int and isinstance(reason.values, dict)
        shaped = shaped and all(isinstance(text, str) for text in texts)
        return found if shaped and (found.max_age_days is None or found.max_age_days >= 0) else None
    except (ValueError, TypeError, KeyError):
        return None


def unrecorded(version: int) -> Validity:
    """Make the validity of a version of which the file has no whole line."""
    text = "Its record is lost. Run a drift check."
    return Validity(version, ValidityState.UNVERIFIED, "", ValidityReason(NO_RECORD, text))


_VALIDITY_KEYS = [known.name for known in fields(Validity)]
_REASON_KEYS = [known.name for known in fields(ValidityReason)]


def _chosen(plain: dict[str, Any], keys: list[str]) -> dict[str, Any]:
    return {key: plain[key] for key in keys if key in plain}


def time_text(when: datetime | None = None) -> str:
    """Format a time (default: now) as UTC in ISO format."""
    return (when or datetime.now(UTC)).astimezone(UTC).isoformat(timespec="seconds")


def parse_time(text: str) -> datetime | None:
    """Parse a time; one without a zone is UTC. None where it is not a time."""
    try:
        found = datetime.fromisoformat(text)
        return found.replace(tzinfo=UTC) if found.tzinfo is None else found.astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def _shown(iso: str) -> str:
    when = parse_time(iso)
    return "an unknown time" if when is None else f"{when:%Y-%m-%d %H:%M} UTC"
