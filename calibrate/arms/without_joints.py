"""What recorded joints would win, in a sentence for whoever records without them."""

from __future__ import annotations

from calibrate.arms.classes import arm_class
from calibrate.arms.kinematics import MODELS


def joints_would_win(robot_model: str, told_class: str = "") -> str:
    """Say what joints with every pose would win, where they are not recorded.

    robot_model, told_class: as `classes.arm_class` takes them. No size is assumed of a model whose kinematics
    are known here.
    """
    win = "Joints with every pose would let the arm's own error be learned"
    if not told_class and robot_model in MODELS:
        return f"{win}."
    of_class = arm_class(robot_model, told_class)
    assumed = f"{1e3 * of_class.shift_m:.2g} mm and {1e3 * of_class.turn_rad:.2g} mrad"
    return f"{win}: without them {assumed} per axis (1σ) are assumed, as of {of_class.title}."
