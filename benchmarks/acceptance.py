"""Weak stops that `station accept` finds, and sound arms that it refuses.

Whole runs of the command against a simulated UR10 (125 Hz) with the real driver: daemon, control process,
trace, judge. Clean runs go by both control paths. Moves that end before their stop is
given, because the computer is too busy, are asked for again. A weakness is planted in the controller
(`tests/weak_controller.py`); it counts as found when the run ends with a figure beyond its limit.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.trials import table, trials
from station.simulation.cell import write_truth
from station.simulation.launch import ChildProcess, start_controller
from station.simulation.scenes import make_cell
from tests.weak_controller import WEAKNESSES

CLEAN = 20
AT_ONCE = 2
PATHS = ("ur_rtde", "script")


def run() -> str:
    """The table as Markdown."""
    clean = [("", PATHS[number % 2]) for number in range(trials(CLEAN))]
    weak = [(weakness, "ur_rtde") for weakness in WEAKNESSES]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        answers = []
        for answer in pool.map(lambda job: accept(*job), [*weak, *clean]):
            answers.append(answer)
            said = "accepted" if answer.get("accepted") else failures(answer) or answer
            print(f"{len(answers)} of {len(weak) + len(clean)}: {said}", file=sys.stderr, flush=True)
    rows = []
    for path in PATHS:
        runs = [a for (_, by), a in zip(clean, answers[len(weak) :], strict=True) if by == path]
        ends = Counter("accepted" if a.get("accepted") else ", ".join(failures(a)) or "ended" for a in runs)
        said = "; ".join(f"{count} {end}" for end, count in ends.most_common())
        rows.append([f"none, by {path}, {len(runs)} runs", said, worst(runs)])
    for (weakness, _), answer in zip(weak, answers, strict=False):
        rows.append([weakness, "found" if failures(answer) else "MISSED", ", ".join(failures(answer)[:2])])
    return table(["planted", "result", "by (first), or largest share of a limit"], rows)


def accept(weakness: str, path: str) -> dict[str, Any]:
    """Run `station accept --json` on one cell and return what it says."""
    with tempfile.TemporaryDirectory(prefix="accept-") as place:
        folder = Path(place)
        truth, control = folder / "truth.json", folder / "s"
        write_truth(make_cell(seed=5), truth)
        module, options = ("tests.weak_controller", ("--weakness", weakness))
        with start_controller(
            "UR10", truth=truth, module=module, options=options, log=folder / "controller.log"
        ) as controller:
            serve = [sys.executable, "-m", "tests.system.cell_daemon", controller.host, str(truth), place]
            with (folder / "daemon.log").open("wb") as log:
                daemon = subprocess.Popen(
                    [*serve, str(control)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env={**os.environ, "CELL_CONTROL": path},
                    start_new_session=True,
                )
            with ChildProcess(daemon):
                assert daemon.stdout is not None
                daemon.stdout.readline()  # ready
                command = [sys.executable, "-m", "station.cli", "accept", "--socket", str(control), "--json"]
                done = subprocess.run(command, capture_output=True, text=True, timeout=400)
                return dict(json.loads(done.stdout)) if done.stdout else {"said": done.stderr}


def failures(answer: dict[str, Any]) -> list[str]:
    """'daemon-frozen: reaction'"""
    return [
        f"{result['way']}: {figure['name']}"
        for result in answer.get("results", [])
        for figure in result["figures"]
        if not passed(figure)
    ]


def passed(figure: dict[str, Any]) -> bool:
    if figure["value"] is None:  # it never came
        return False
    return bool(figure["value"] >= figure["limit"] if figure["least"] else figure["value"] <= figure["limit"])


def worst(runs: list[dict[str, Any]]) -> str:
    """The figure that came nearest to its limit in any of them."""
    shares = [
        (figure["value"] / figure["limit"], f"{result['way']}: {figure['name']}")
        for answer in runs
        for result in answer.get("results", [])
        for figure in result["figures"]
        if not figure["least"] and figure["limit"] > 0 and figure["value"] is not None
    ]
    share, name = max(shares, default=(0.0, "no figures"))
    return f"{100 * share:.0f} %: {name}"


if __name__ == "__main__":
    print(run())
