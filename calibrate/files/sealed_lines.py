"""JSON lines that carry a checksum, so that a line that was damaged is told from one that was written.

    {"version":3,"state":"withdrawn",…,"sha256":"9f2c51d0a4e8b376"}

The last key of a sealed line holds the first digits of the SHA-256 of the same object without that key, byte
for byte. Every changed, added or missing byte breaks it, also where it joins two lines or splits one.

Needs only the standard library, because programs that use the camera read such lines too (`loader`).
"""

from __future__ import annotations

import hashlib
import re

SEAL_KEY = "sha256"
_DIGITS = 16
"""64 bits: damage that passes by chance is not to be expected."""
_SEAL_LENGTH = len(f',"{SEAL_KEY}":""}}') + _DIGITS


def seal(content: bytes) -> bytes:
    """Add the checksum to an encoded JSON object, which is not empty and has no line feed."""
    digits = hashlib.sha256(content).hexdigest()[:_DIGITS]
    return content[:-1] + f',"{SEAL_KEY}":"{digits}"}}'.encode()


def sealed_content(line: bytes) -> bytes | None:
    """Return the object of a sealed line without its checksum; None where that is missing or wrong."""
    content = line[:-_SEAL_LENGTH] + b"}"
    return content if seal(content) == line else None


def is_torn(end: bytes) -> bool:
    """Tell whether the end of a file is the beginning of a line, as a crash leaves it behind.

    The writer never said that such a line was written. A whole object, with anything behind it or not, is
    none; neither is what holds a control character, which JSON never writes.
    """
    if not end.startswith(b"{") or _CONTROL.search(end):
        return False
    depth = 0
    for byte in _STRING.sub(b"", end):
        if byte in b"{[":
            depth += 1
        elif byte in b"}]":
            depth -= 1
        if depth == 0:
            return False
    return True


_CONTROL = re.compile(rb"[\x00-\x1f]")
_STRING = re.compile(rb'"(?:[^"\\]|\\.)*(?:"|\\?\Z)')
"""A string, or the beginning of one at the end."""
