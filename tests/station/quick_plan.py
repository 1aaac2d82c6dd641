"""A plan for tests that drive one: from fewer candidates than usual, which takes a fifth of the time."""

from __future__ import annotations

from station.cell.config import StationConfig
from station.cell.layout import layout_of
from station.cell.pose_plan import Plan
from station.plan.planner import PlanOptions, plan_layout
from station.simulation.truth import CellTruth

POOL = 200


def quick_plan(config: StationConfig, truth: CellTruth, seed: int, count: int) -> Plan:
    options = PlanOptions(count=count, seed=seed, pool=POOL)
    return plan_layout(layout_of(config), options, truth.start_joints_rad)
