"""Messages on the control socket: JSON lines of at most 64 kB, allow-listed verbs, typed arguments.

client → daemon   {"id": 1, "verb": "go", "args": {…}}
daemon → client   {"id": 1, "ok": true, "result": {…}}      or   {"id": 1, "ok": false, "error": "…"}
                  {"status": {…}}      full, right after `watch`
                  {"changes": {…}}     changed top-level sections of the status
`stop` needs no lease and is handled before anything that is queued, pieces of a long request included. It has
a socket of its own as well, which needs no connection: `station.server.stop_server`.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

LINE_LIMIT_BYTES = 64 * 1024
REQUEST_LIMIT_BYTES = 2 * 1024 * 1024
"""Of a request in pieces: a plan of some thousand poses. A connection costs the daemon no more than that."""
PIECE_BYTES = 32 * 1024
CLIENT_LIMIT = 64
USER_CLIENT_LIMIT = 16
"""One user cannot take the others' places."""

Verb = Literal[
    "hello",  # {who} → {version, pid}
    "watch",  # → status, then changes
    "lease",  # {action: take|release|lost}; lost: nobody is at the screen that holds it
    "stop",  # now; from anyone
    "acknowledge",  # leave `stopped` or `fault` after a person looked
    "plan",  # → the loaded plan
    "load_plan",  # {plan: {…}} inline plan; checked, refused with all problems
    "make_plan",  # {poses, seed, lens_known} → made in a worker, then loaded
    "prepare",  # {purpose: run|check|resume|retake|improve|best, index?} → GoSummary; checks the whole way
    "hover",  # {calibration?, corner, standoff_m, …} → HoverOffer; a slow way over a corner of the board
    "go",  # {token, plan_sha256?, headless?} approves that summary; see station.server.approval
    "pause",  # after this pose
    "finish",  # seal what is there
    "retake",  # {index}
    "skip",  # {index}
    "reorder",  # {order: [indices]}
    "add",  # {pose}
    "drop",  # {index}
    "free_drive",  # {on: bool}
    "record",  # capture here and now (free-drive)
    "preview",  # {width, height} → {jpeg_base64, width, height, corners, sequence}
    "doctor",  # → [{name, state, text, remedy}]
    "sessions",  # → [{name, folder, views, sealed, …}]
    "part",  # {base64} the next piece of a request that is longer than a line
    "whole",  # → what the request in the pieces answers
]


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    id: int
    verb: Verb
    args: dict[str, Any] = {}


class Reply(msgspec.Struct, frozen=True, omit_defaults=True):
    id: int
    ok: bool
    result: Any = None
    error: str = ""


class Notice(msgspec.Struct, frozen=True, omit_defaults=True):
    """Unasked-for line to a watcher; exactly one field is set."""

    status: dict[str, Any] | None = None
    changes: dict[str, Any] | None = None
