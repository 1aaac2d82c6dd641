"""Validity of an installed calibration: valid, unverified, in doubt or withdrawn; since when, and why.

    …/validity.jsonl     one line for each install, check, doubt and withdrawal; a version's last line counts;
                         a line with `switch` is also the log of an install or a rollback

Needs only the standard library, because programs that use the camera load it too (`loader`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Any

from calibrate.errors import InstallError

FILE = "validity.jsonl"
LONGEST_AGE_DAYS = 36_500
"""A longer limit of the last proof's age is a slip."""
WITHDRAWN_REMEDY = (
    "Solve a new recording and run `calibrate install FILE`, "
    "or `calibrate rollback NUMBER` to another version of `calibrate list`"
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
    camera-changed, too-old, withdrawn; more may come."""
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
        """Return the validity at a time: in doubt once the last proof is older than `max_age_days`."""
        proven = self._proven(now)
        said_already = self.state in (ValidityState.IN_DOUBT, ValidityState.WITHDRAWN)
        if self.max_age_days is None or proven is None or said_already:
            return self
        age_days = (now - proven) / timedelta(days=1)
        if not age_days > self.max_age_days:
            return self
        due = proven + timedelta(days=self.max_age_days)
        text = f"The last proof is {age_days:.1f} days old (limit {self.max_age_days:g}). Run a drift check."
        limits: dict[str, str | float | int | bool | None] = {
            "age_days": round(age_days, 3),
            "limit_days": self.max_age_days,
        }
        reason = ValidityReason("too-old", text, limits)
        return replace(self, state=ValidityState.IN_DOUBT, since=time_text(due), reason=reason)

    def after_check(
        self, reason: ValidityReason, passed: bool, proves: bool, when: datetime, who: str
    ) -> Validity:
        """Return the validity after a check on views taken at `when`; the kind of check is `reason.code`.

        `proves`: a pass had enough power, or a failure could tell a camera's shift from other errors. Then a
        failure puts it in doubt and a pass makes it valid. Otherwise a failure makes it unverified, unless it
        is in doubt already. A pass then ends a doubt of the same kind of check; any other doubt becomes
        unverified. Views from before the last proof change nothing. No check restores a withdrawn version.
        """
        proven = self._proven(datetime.now(UTC))
        if self.state is ValidityState.WITHDRAWN or (proven is not None and when < proven):
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
    def remedy(self) -> str:
        """What makes it usable again; one that is valid needs nothing of it."""
        withdrawn = self.state is ValidityState.WITHDRAWN
        return WITHDRAWN_REMEDY if withdrawn else "Run `station drift-check`, or calibrate again"

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


def parse_validity(content: bytes) -> dict[int, Validity]:
    """Parse the last record of each version; `Validity.at` gives its state now.

    Torn lines and lines of another shape are skipped; of a line, what a later version adds.
    """
    return {entry.version: entry for line in content.splitlines() if (entry := _parse(line)) is not None}


def unrecorded(version: int) -> Validity:
    """Make the validity of a version of which the file has no whole line."""
    text = "Its record is lost. Run a drift check."
    return Validity(version, ValidityState.UNVERIFIED, "", ValidityReason("no-record", text))


def _parse(line: bytes) -> Validity | None:
    try:
        plain = json.loads(line)
        reason = ValidityReason(**_known(ValidityReason, plain["reason"]))
        named = {"state": ValidityState(plain["state"]), "reason": reason}
        found = Validity(**_known(Validity, plain) | named)
        texts = found.since, found.who, found.verified, reason.code, reason.text
        shaped = type(found.version) is int and isinstance(reason.values, dict)
        shaped = shaped and all(isinstance(text, str) for text in texts)
        return found if shaped and (found.max_age_days is None or found.max_age_days >= 0) else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _known(kind: type[Validity | ValidityReason], plain: dict[str, Any]) -> dict[str, Any]:
    return {known.name: plain[known.name] for known in fields(kind) if known.name in plain}


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
