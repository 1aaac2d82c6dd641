"""Which run carries out a go."""

from __future__ import annotations

from station.session.bench import Bench
from station.session.hovering import HoverRun
from station.session.lease import Go
from station.session.run import Run
from station.session.sweeping import SweepRun


def run_for(bench: Bench, go: Go) -> Run:
    """By what the person said yes to: a hover, or the plan's poses as stops or as a sweep."""
    if go.hover is not None:
        return HoverRun(bench, go, go.hover)
    return SweepRun(bench, go) if bench.require_queue().plan.motion == "sweep" else Run(bench, go)
