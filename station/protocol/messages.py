"""Messages on the control socket: JSON lines of at most 1 MB, answers of at most 2 MB.

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
from collections.abc import Callable, Mapping
from typing import Any, get_type_hints

import msgspec

from recordings.errors import CodedError, ErrorData
from recordings.plain_text import plain_data
from station.cell.errors import StationError
from station.cell.plain import builtins_of
from station.cell.status import StationStatus

log = logging.getLogger(__name__)

LINE_LIMIT_BYTES = 1024 * 1024
"""Longest request, enough for a plan of a thousand poses; bounds memory per connection."""
ANSWER_LIMIT_BYTES = 2 * 1024 * 1024
"""Longest line from the daemon, enough for a status of two thousand poses. A client that has not read twice
as much is dropped."""
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
    """Encode a reply as a line that its client can read, whatever a defect has put into it.

    That may be a number of NumPy's, half a surrogate pair, NaN where a number is needed, or a text without
    end. What can be converted is; a client whose result cannot be is told so.
    """
    try:
        return _result_line(answer)
    except _UNENCODABLE as error:
        log.error("an answer could not be encoded: %.200r", error)
    for convert in (_plain, _short):
        try:
            return _result_line(_converted(answer, convert))
        except _UNENCODABLE as error:
            why = repr(error)[:_REASON_LETTERS]
    defect = StationError("internal", error=f"its answer could not be encoded: {why}")
    return _line(_converted(Answer.refused(answer.id or 0, defect), _short))


def news_line(sections: Mapping[str, object], whole: bool) -> tuple[bytes, dict[str, str]]:
    """Encode sections of the status as a line that every client can read.

    Return also the sections that are left out, as no client could read them, with the reason. `whole`: all
    of the status is there, not only what changed.
    """
    try:
        line = _line(_news(sections, whole))
        msgspec.json.decode(line, type=_News)  # as a client does
        return line, {}
    except _UNENCODABLE:
        pass
    readable = {}
    left_out = {}
    room_bytes = ANSWER_LIMIT_BYTES - _FRAME_BYTES
    for name, section in sections.items():
        try:
            plain = _short(section)
            encoded = msgspec.json.encode(plain)
            msgspec.json.decode(encoded, type=_SECTIONS[name])
            _require_size(encoded, room_bytes)
        except _UNENCODABLE as error:
            left_out[name] = repr(error)
            continue
        readable[name] = plain
        room_bytes -= len(encoded) + len(name) + 4
    return _line(_news(readable, whole)), left_out


class _News(msgspec.Struct, frozen=True):
    """Line of news, as a client decodes it."""

    status: StationStatus = StationStatus()
    changes: StationStatus = StationStatus()


_UNENCODABLE = (TypeError, ValueError, OverflowError, RecursionError, msgspec.MsgspecError)
_SECTIONS = get_type_hints(StationStatus)
"""Type of each section of the status."""
_TEXT_LIMIT = 4000
"""Longest text in a line that would be too long else."""
_REASON_LETTERS = 400
"""Most letters of why an answer could not be encoded."""
_FRAME_BYTES = 100
"""Room for what stands around the sections."""


def _news(sections: Mapping[str, object], whole: bool) -> Answer:
    return Answer(status=dict(sections)) if whole else Answer(changes=dict(sections))


def _line(answer: Answer) -> bytes:
    """Encode a line. ValueError where it is longer than any client takes."""
    line = msgspec.json.encode(answer) + b"\n"
    _require_size(line, ANSWER_LIMIT_BYTES)
    return line


def _require_size(encoded: bytes, limit_bytes: int) -> None:
    if len(encoded) > limit_bytes:
        raise ValueError(f"{len(encoded)} bytes, the limit is {limit_bytes}")


def _result_line(answer: Answer) -> bytes:
    """Encode a reply. Raises one of `_UNENCODABLE` also where its client could not decode the result."""
    line = _line(answer)
    if isinstance(answer.result, msgspec.Struct):
        msgspec.convert(msgspec.json.decode(line, type=Answer).result, type(answer.result))
    return line


def _converted(answer: Answer, convert: Callable[[object], Any]) -> Answer:
    """Convert a reply; where its result is a struct, to the types that its client expects."""
    result = answer.result
    if isinstance(result, msgspec.Struct):
        return msgspec.structs.replace(answer, result=msgspec.convert(convert(result), type(result)))
    return msgspec.convert(convert(answer), Answer)


def _plain(value: object) -> Any:
    """Convert structs, enums and scalars of other libraries to what JSON knows."""
    return plain_data(builtins_of(value))


def _short(value: object) -> Any:
    """Convert as `_plain`, and shorten every long text."""
    return _shortened(_plain(value))


def _shortened(value: Any) -> Any:
    """Shorten every long text in plain data; keys included, as they may be as long."""
    if isinstance(value, str):
        return value if len(value) <= _TEXT_LIMIT else value[: _TEXT_LIMIT - 1] + "…"
    if isinstance(value, dict):
        return {_shortened(key): _shortened(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_shortened(each) for each in value]
    return value
