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

from typing import Any

import msgspec

from recordings.errors import CodedError, ErrorData

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
