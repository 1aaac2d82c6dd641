"""Prints too long sentences of the written pages, their mean, and all words: `python docs/sentences.py`."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONGEST, MEAN, WORDS = 30, 18, 16_200


def pages() -> list[Path]:
    """Those that people write: not the reference, the benchmarks' page and the index of decisions."""
    made = {ROOT / "docs/contributor/benchmarks.md", ROOT / "docs/decisions/README.md"}
    books = [path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "reference"]
    return [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(set(books) - made)]


def sentences(text: str) -> Iterator[str]:
    """Prose and list items, without code, headings and rows of tables."""
    text = re.sub(r"```.*?```", "\n", text, flags=re.DOTALL)
    text = re.sub(r"^(    |#|[|]).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    for part in re.split(r"\n\s*\n|\n(?=\s*(?:[-*>]|\d+\.) )", text):
        for sentence in re.split(r"(?<=[.!?])[*)]*\s+(?=[^a-z])", " ".join(part.split())):
            if len(words := [word for word in sentence.split() if re.search(r"\w", word)]) > 1:
                yield " ".join(words)


if __name__ == "__main__":
    found = [(path, sentence) for path in pages() for sentence in sentences(path.read_text())]
    mean = sum(len(sentence.split()) for _, sentence in found) / len(found)
    for path, sentence in found:
        if len(sentence.split()) > LONGEST:
            print(f"{path.relative_to(ROOT)}: {len(sentence.split())} words: {sentence}")
    words = sum(len(re.findall(r"\S*\w\S*", path.read_text())) for path in pages())  # with code and tables
    print(f"{len(found)} sentences, {mean:.1f} words each, {words} words in all")
    sys.exit(mean > MEAN or words > WORDS or any(len(said.split()) > LONGEST for _, said in found))
