"""The project's words: one table, `words.toml`, that screen, gates and pages show."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from importlib.resources import files

import msgspec


class Word(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"retired": "not"}):
    """A word for one thing, as a person reads it."""

    term: str
    group: str
    """Heading under which it stands."""
    meaning: str
    """In one or two sentences."""
    bad: str = ""
    """What to do when it is bad; empty: it has no better or worse."""
    unit: str = ""
    """Of its figure; empty for plain numbers and where it has none."""
    gate: str = ""
    """Id of the gate whose title it is."""
    shown: tuple[str, ...] = ()
    """Other forms in which screens write it."""
    retired: tuple[str, ...] = ()
    """Words that are not used for it."""

    @property
    def title(self) -> str:
        """The word at the beginning of a line."""
        return self.term[:1].upper() + self.term[1:]

    @property
    def plain_meaning(self) -> str:
        """The meaning without the marks of a page."""
        return re.sub(r"[*`]", "", self.meaning)


@cache
def words() -> tuple[Word, ...]:
    """Return all words in the order of the table."""
    table = tomllib.loads((files("calibrate") / "words.toml").read_text("utf-8"))
    return tuple(
        msgspec.convert({"term": term, "group": group} | entry, Word)
        for group, entries in table.items()
        for term, entry in entries.items()
    )


@cache
def words_of_gates() -> dict[str, Word]:
    """Return the words that are titles of gates, by the gate's id."""
    return {word.gate: word for word in words() if word.gate}


def word_of(term: str) -> Word:
    """Return a word of the table; KeyError where it has none of this name."""
    return {word.term: word for word in words()}[term]


def words_in(text: str) -> tuple[Word, ...]:
    """Find the words that a text uses, in the order of the table."""
    return tuple(word for word in words() if any(_stands_in(form, text) for form in (word.term, *word.shown)))


def _stands_in(form: str, text: str) -> bool:
    return re.search(rf"(?<!\w){re.escape(form)}(?!\w)", text, re.IGNORECASE) is not None
