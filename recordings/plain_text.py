"""Text as a terminal may get it: what somebody else wrote made harmless, and sizes for people.

A file, a recording, a camera or a robot may hold characters that a terminal takes for orders: colours, a
moved cursor, a new window title, lines that overwrite what stood there, letters in another order.
"""

from __future__ import annotations

import re
from typing import Any

ORDERS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters but for tab and line feed, marks that turn the direction of writing, and what Python
makes of bytes that are no UTF-8."""
DEVICE_TEXT_LIMIT = 200
SIGN = "\N{REPLACEMENT CHARACTER}"


def plain_text(text: str) -> str:
    """The same text with a sign in place of each order to the terminal."""
    return ORDERS.sub(SIGN, text)


def device_text(text: str) -> str:
    """What a device says of itself, without what no name needs: orders to the terminal, and space around it.

    Fields of fixed length end in NUL bytes, and what a scanner read in a carriage return. Nothing is put in
    their place, so that one device is named alike by whatever way it is asked. At most `DEVICE_TEXT_LIMIT`
    letters.
    """
    line = text.replace("\t", " ").replace("\n", " ")
    return ORDERS.sub("", line).strip()[:DEVICE_TEXT_LIMIT].strip()


def plain_data(value: Any) -> Any:
    """`plain_text` for every text in plain data (dict, list, scalars), keys included."""
    if isinstance(value, str):
        return plain_text(value)
    if isinstance(value, dict):
        return {plain_data(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_data(item) for item in value]
    return value


def printed(problem: Exception) -> str:
    """An error as all commands print it: without a full stop at its end."""
    said = plain_text(str(problem))
    return said[:-1] if said.endswith(".") and not said.endswith((" .", "/.", "..")) else said


def bytes_text(count: int) -> str:
    """Write a size for people: 4.0 GB, 120 MB."""
    if count < 1_000_000:
        return f"{count / 1e3:.0f} kB"
    return f"{count / 1e9:.1f} GB" if count >= 1_000_000_000 else f"{count / 1e6:.0f} MB"
