"""Which run carries out a go."""

from __future__ import annotations

from station.session.context import SessionContext
from station.session.hovering import HoverRun
from station.session.lease import MotionApproval
from station.session.run import Run
from station.session.sweeping import SweepRun


def run_for(context: SessionContext, go: MotionApproval) -> Run:
    """By what the person said yes to: a hover, or the plan's poses as stops or as a sweep."""
    if go.hover is not None:
        return HoverRun(context, go, go.hover)
    return SweepRun(context, go) if context.require_queue().plan.motion == "sweep" else Run(context, go)
