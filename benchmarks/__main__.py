"""`python -m benchmarks [name …]`: run benchmarks, write results/NAME.md and the page in docs.

Every module here with a `run() -> str` is one. BENCH_SHARE=0.05 runs a twentieth of the trials,
BENCH_SETS=six-views,denso-long only these recordings (real, mistakes). `--page` writes the page alone.
"""

from __future__ import annotations

import importlib
import itertools
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs/contributor/benchmarks.md"
RESULTS = HERE / "results"
HEAD = """# Benchmarks
Made by `python -m benchmarks`; do not edit. Each table shows the rows that say most. All of them, how they
were measured, on what computer, how many trials: `benchmarks/results/NAME.md`. `python -m benchmarks NAME`
measures anew. Robot and camera are simulated unless said otherwise.
"""
SHOWN: dict[str, str] = {
    "real": r"^\| (ours /|the same|sets|split|good views|sukai|justmy|nirshal|kvasios|panda|\*\*median)",
    "coverage": r"^\| (clean|size 0.5 %|bent 0.5 mm|arm 0.4 mm, arm unknown.*) \| eye-to",
    "outliers": r"^\| (far|shuffled) \| 40 % \| eye-in|moved \| 35 % \| eye-in",
    "any_arm": r"^\| seven joints",
    "mistakes": r"^\*\*",
    "misread_poses": r"^\*\*",
    "moved": r"^\| (nothing|board|camera) \| \d \| swept",
    "offline": r"all\*\*|OpenCV: read|ratio|peak",
    "library_cpu": r"^\| 25",
    "planning": r"^\| (moderate|wide) \| planned 25|^\| (full plan|moves that touch|predicted)",
    "by_hand": r"^\| (all|ur)",
    "drift": r"^\| (ur|seven joints) ",
    "late_news": r"^\| all",
    "stop_latency": r"^\| \d+ \|",
}
"""The rows of each benchmark that the page shows, as a pattern; in the page's order."""
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
    if sys.argv[1:] == ["--page"]:
        _replace(PAGE, page())
        return 0
    names = sys.argv[1:] or sorted(_benchmarks())
    unknown = set(names) - set(_benchmarks())
    if unknown:
        print(
            f"no benchmark named {', '.join(sorted(unknown))}; there are: {', '.join(sorted(_benchmarks()))}"
        )
        return 2
    if any(os.environ.get(name) != "1" for name in _THREADS):
        # BLAS reads these once, when it is loaded
        environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
        return subprocess.call([sys.executable, "-m", "benchmarks", *names], env=environment)
    for name in names:
        start = time.perf_counter()
        print(f"{name} …", flush=True)
        text = importlib.import_module(f"benchmarks.{name}").run()
        took_s = time.perf_counter() - start
        _write(name, f"{text}\n\n{_where()}; took {took_s:.0f} s.")
        print(text, flush=True)
    _replace(PAGE, page())
    return 0


def _benchmarks() -> list[str]:
    """Modules beside this one that define `run`, found by their text so that none is imported in vain."""
    pattern = re.compile(r"^def run\(\) -> str:", re.MULTILINE)
    return [p.stem for p in HERE.glob("*.py") if not p.stem.startswith("_") and pattern.search(p.read_text())]


def _where() -> str:
    share = os.environ.get("BENCH_SHARE", "1")
    note = "" if share == "1" else f", {share} of the full trials"
    return f"Python {platform.python_version()}, {os.cpu_count()} cores, one BLAS thread{note}"


def _write(name: str, text: str) -> None:
    """Keep all rows in results/NAME.md. Title: the module's first docstring line."""
    title = (importlib.import_module(f"benchmarks.{name}").__doc__ or name).strip().splitlines()[0]
    _replace(RESULTS / f"{name}.md", f"# {title}\n`python -m benchmarks {name}`\n\n{text}\n")


def page() -> str:
    """The rows in SHOWN of every result."""
    sections = [HEAD]
    for name, wanted in SHOWN.items():
        text = (RESULTS / f"{name}.md").read_text()
        title = text.partition("\n")[0].removeprefix("# ")
        sections.append(f"\n## {name}\n{title}\n" + "\n".join(_shown(text, wanted)) + "\n")
    return "".join(sections)


def _shown(text: str, wanted: str) -> Iterator[str]:
    """Rows that match, each table with its head (the head's rule is short), and short lines that match."""
    head: list[str] = []
    for line, after in itertools.pairwise([*text.splitlines()[2:], ""]):
        row = line.startswith("|")
        if re.fullmatch(r"\|([- ]+\|)+", after):
            head = ["", line, "|-" * (after.count("|") - 1) + "|"]
        elif re.search(wanted, line) and (row or len(line) <= 80) and not re.fullmatch(r"\|([- ]+\|)+", line):
            yield from head if row else [""]
            yield line
            head = []


def _replace(path: Path, text: str) -> None:
    partial = path.with_suffix(".tmp")
    partial.write_text(text)
    partial.replace(path)


if __name__ == "__main__":
    sys.exit(main())
