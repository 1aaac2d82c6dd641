"""The figures that docs/operator/safety.md promises, written out.

Whoever changes a constant changes the promise.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from station.cell import limits, status
from station.devices import news
from station.devices.ur import child, control, moves
from station.session import motion, supervisor

PROMISES = (Path(__file__).parents[3] / "docs/operator/safety.md").read_text()


@pytest.mark.parametrize(
    ("figure", "most", "promised"),
    [
        (limits.SPEED_CAP_M_S, 0.25, "0.25 m/s at any point on the surface"),
        (limits.JOINT_SPEED_CAP_RAD_S, 1.05, "1.05 rad/s and 1.4 rad/s²"),
        (limits.JOINT_ACCELERATION_CAP_RAD_S2, 1.4, "1.05 rad/s and 1.4 rad/s²"),
        (moves.JOINT_SPEED_LIMIT_RAD_S, 1.05, "refuses more than 1.05 rad/s or 1.5 rad/s²"),
        (moves.JOINT_ACCELERATION_LIMIT_RAD_S2, 1.5, "refuses more than 1.05 rad/s or 1.5 rad/s²"),
        (1 / control.WATCHDOG_HZ, 0.2, "silent for 0.2 s"),
        (control.BEAT_FRESH_NS / 1e9, 0.1, "silent for 0.2 s"),
        (news.MOVING_S, 0.25, "no fresh state for 0.25 s in mid-move"),
        (news.RESTING_S, 1.0, "(1 s at rest)"),
        (moves.STRAYED_RAD, 0.05, "(by 0.05 rad)"),
        (moves.SLIDER_ZERO_S, 10.0, "after 10 s the move is given up"),
        (moves.STOP_RAD_S2, 4.0, "the joints brake with 4 rad/s²"),
        (status.APPROVAL_LIFETIME_S, 120.0, "It is for one use"),
        (motion.START_TOLERANCE_RAD, 0.005, "from where the arm stood"),
    ],
)
def test_a_limit_is_the_one_that_is_promised(figure: float, most: float, promised: str) -> None:
    assert figure == pytest.approx(most)
    assert promised in PROMISES


def test_a_heartbeat_reaches_the_controller_before_its_watchdog_bites() -> None:
    """The loop beats, the child takes beats of a certain age, the script waits for its kick."""
    assert supervisor.TICK_S < child.HEARD_NS / 1e9 < control.BEAT_FRESH_NS / 1e9 < news.SILENCE_S
    assert news.SILENCE_S < 1 / control.WATCHDOG_HZ
