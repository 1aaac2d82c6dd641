"""Messages on the control socket: JSON lines of at most 1 MB.

client → daemon   {"id": 1, "verb": "go", "args": {…}}
daemon → client   {"id": 1, "ok": true, "result": {…}}
                  {"id": 1, "ok": false, "error": "…", "problem": {"code": …, "text": …, "remedy": …, …}}
                  {"status": {…}}      full, right after `watch`
                  {"changes": {…}}     changed top-level sections of the status
The verbs: `station.protocol.verbs`. `stop` needs no control and is handled before anything that is queued;
it also has a socket of its own: `station.server.stop_server`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, get_type_hints

import msgspec

from recordings.errors import CodedError, ErrorData, plain_value
from recordings.plain_text import plain_data
from station.cell.errors import StationError
from station.cell.status import StationStatus

log = logging.getLogger(__name__)

LINE_LIMIT_BYTES = 1024 * 1024
"""Longest request, enough for a plan of a thousand poses; bounds memory per connection."""
CLIENT_LIMIT = 64
USER_CLIENT_LIMIT = 16
"""Most clients of one user, so that places are left for others."""


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    id: int
    verb: str
    args: msgspec.Raw = msgspec.Raw(b"{}")
    """Kept as it came until the verb tells its type: nothing large is made of nonsense."""


class Answer(msgspec.Struct, frozen=True, omit_defaults=True):
    """Line from the daemon: the reply to a request, or, to a watcher and without `id`, news of the status."""

    id: int | None = None
    ok: bool | None = None
    result: object = None
    error: str = ""
    """Error as a sentence for people; for programs see `problem`."""
    problem: ErrorData | None = None
    status: Any = None
    """The whole status."""
    changes: dict[str, Any] | None = None

    @classmethod
    def refused(cls, request_id: int, error: CodedError) -> Answer:
        return cls(request_id, False, error=str(error), problem=error.data)


def answer_line(answer: Answer) -> bytes:
    """Encode an answer as a line that every client can read, whatever a defect has put into it.

    That may be a number of NumPy's, half a surrogate pair, or NaN where a number is needed. What can be
    converted is; a section of the status that cannot be is left out; a client whose result cannot be encoded
    is told so.
    """
    if answer.status is not None:
        return _sections_line(answer, msgspec.structs.asdict(answer.status), "status")
    if answer.changes is not None:
        return _sections_line(answer, answer.changes, "changes")
    try:
        return msgspec.json.encode(answer) + b"\n"
    except _UNENCODABLE as error:
        log.error("an answer could not be encoded: %r", error)
    try:
        return msgspec.json.encode(_plain(answer)) + b"\n"
    except _UNENCODABLE as error:
        defect = StationError("internal", error=f"its answer could not be encoded: {error!r}")
        return msgspec.json.encode(_plain(Answer.refused(answer.id or 0, defect))) + b"\n"


_UNENCODABLE = (TypeError, ValueError, OverflowError, RecursionError, msgspec.MsgspecError)
_ANSWER = msgspec.json.Decoder(Answer)
_SECTIONS = get_type_hints(StationStatus)
"""Type of each section of the status."""


def _sections_line(answer: Answer, sections: Mapping[str, object], kind: str) -> bytes:
    """Encode news of the status, section by section where something is wrong with them."""
    try:
        line = msgspec.json.encode(answer) + b"\n"
        msgspec.convert(getattr(_ANSWER.decode(line), kind), StationStatus)  # as a client does
        return line
    except _UNENCODABLE as error:
        log.error("no client could read the status: %r", error)
    readable = {}
    for name, section in sections.items():
        try:
            plain = _plain(section)
            msgspec.json.decode(msgspec.json.encode(plain), type=_SECTIONS[name])
            readable[name] = plain
        except _UNENCODABLE as error:
            log.error("section %s of the status is left out: %r", name, error)
    return msgspec.json.encode(Answer(**{kind: readable})) + b"\n"  # type: ignore[arg-type]


def _plain(value: object) -> Any:
    """Convert structs, enums and scalars of other libraries to what JSON knows."""
    return plain_data(msgspec.to_builtins(value, enc_hook=plain_value))
