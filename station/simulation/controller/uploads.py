"""Programs that arrive as text, and where one ends."""

from __future__ import annotations

import re
from dataclasses import dataclass

_BEGIN = re.compile(r"^(?:def|sec)\s+(\w+)\s*\([^\n]*\)\s*:[ \t]*$", re.MULTILINE)
_END = re.compile(r"^end[ \t]*\r?\n", re.MULTILINE)


@dataclass(frozen=True)
class Upload:
    """One complete program, or one bare line."""

    name: str
    """'' for a bare line."""
    text: str


class UploadReader:
    """Collects text until a program is complete."""

    def __init__(self) -> None:
        self._text = ""

    def feed(self, data: bytes) -> list[Upload]:
        self._text += data.decode("utf-8", errors="replace")
        uploads = []
        while True:
            begin = _BEGIN.match(self._text)
            if begin is not None:
                end = _END.search(self._text, begin.end())
                if end is None:
                    break
                text, self._text = self._text[: end.end()], self._text[end.end() :]
                uploads.append(Upload(begin.group(1), text))
                continue
            line, newline, rest = self._text.partition("\n")
            if not newline:
                break
            self._text = rest
            if line.strip() and not line.lstrip().startswith("#"):
                uploads.append(Upload("", line.strip()))
        return uploads
