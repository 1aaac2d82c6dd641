"""What only recordings of earlier versions have: it is taken off here, and nothing else knows of it.

No format number is used twice. A key may be added with a default. A key that is written and goes, or changes
its meaning, needs a new number. Needs the standard library alone.
"""

from __future__ import annotations

from typing import Any

GONE_OF_BOARD = frozenset({"radon_marker"})
"""Keys of a `BoardSpec` that are without effect."""
GONE_OF_ROBOT = frozenset({"safety_checksum"})
"""Keys of a `RobotIdentity` that are without effect."""


def lift_session(plain: Any) -> Any:
    """Make a session's description, as plain data of any version, today's. What is wrong in it stays wrong.

    Only its `board` and `robot` differ, which a calibration file has, too.
    """
    if not isinstance(plain, dict):
        return plain
    lifted = dict(plain)
    for name, gone in (("board", GONE_OF_BOARD), ("robot", GONE_OF_ROBOT)):
        told = lifted.get(name)
        if isinstance(told, dict):
            lifted[name] = {key: value for key, value in told.items() if key not in gone}
    return lifted
