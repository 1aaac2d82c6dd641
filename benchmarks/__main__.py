"""`python -m benchmarks [name …]`: run benchmarks and write their tables into benchmarks/README.md.

Every module here with a `run() -> str` is one. BENCH_SHARE=0.05 runs a twentieth of the trials,
BENCH_SETS=six-views,denso-long only these recordings (real, mistakes).
"""

from __future__ import annotations

import importlib
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
README = HERE / "README.md"
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> int:
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
    """Replace the section of this benchmark, or append it. Title: the module's first docstring line."""
    title = (importlib.import_module(f"benchmarks.{name}").__doc__ or name).strip().splitlines()[0]
    section = f"<!-- {name} -->\n## {title}\n`python -m benchmarks {name}`\n\n{text}\n<!-- /{name} -->"
    page = README.read_text() if README.exists() else "# Benchmarks\n"
    pattern = re.compile(rf"<!-- {name} -->.*?<!-- /{name} -->", re.DOTALL)
    if pattern.search(page):
        page = pattern.sub(lambda _: section, page)
    else:
        page = page.rstrip() + "\n\n" + section + "\n"
    partial = README.with_suffix(".tmp")
    partial.write_text(page)
    partial.replace(README)


if __name__ == "__main__":
    sys.exit(main())
