"""Classes of arms, and how far the flange of each is from where its controller's kinematics have it.

Without joints the arm's mean error over the workspace cannot be seen in the views: its size is looked up
here. The figures are those that makers and published measurements state; none was fitted to this project's
own simulation. Where a distance is published, its mean is 1.6 σ per axis. Orientations are published for
few arms: where none is, the turn is that which moves the flange by `shift_m` at the usual reach of the class.

Whoever knows the size of one arm's error tells it instead (`robot_accuracy_mm`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from calibrate.errors import require_choice

UNKNOWN = "unknown"
SEVEN = "seven-joints"
_SIX = "industrial-six"
_UR = "universal-robots"
_SERVO = "servo"


@dataclass(frozen=True)
class ArmClass:
    """Arms that are about as far from their own kinematics as each other."""

    name: str
    """As it is written in a cell file and behind `--arm-class`."""
    title: str
    """The class in a person's words, as in "of an arm of Universal Robots"."""
    shift_m: float
    """1σ per axis of the error of the flange's position over the workspace, its base registered, metres."""
    turn_rad: float
    """1σ per axis of the error of its orientation, radians."""
    repeatability_m: float
    """Distance within which it returns to the same posture, as makers state it (ISO 9283), metres."""
    source: str
    """Who states these figures."""


_INDUSTRIAL = (
    ArmClass(
        _UR,
        "an arm of Universal Robots",
        shift_m=0.4e-3,
        turn_rad=0.5e-3,
        repeatability_m=0.1e-3,
        source=(
            "Universal Robots (2025) calibrates each arm's kinematics at the factory and states a "
            "repeatability of 0.03 to 0.1 mm; of such six-axis arms integrators report misses of 0.2 to 2 mm "
            "(Industrial Monitor Direct), 0.07 mm an axis within a small volume (Khanesar, Piano and Branson "
            "2022), and 2.6 mm where the factory's calibration is not used (Jacobi 2025); no orientation is "
            "published."
        ),
    ),
    ArmClass(
        _SIX,
        "an industrial arm of six joints",
        shift_m=0.6e-3,
        turn_rad=1.5e-3,
        repeatability_m=0.1e-3,
        source=(
            "Uncalibrated arms miss by about 1 mm in the mean: an ABB IRB 1600 (Nubiola and Bonev 2013) and "
            "a KUKA KR5 arc HW (Morozov and others 2016); the IRB 1600 turns wrongly by up to 2.8 mrad "
            "(Slamani, Nubiola and Bonev 2012)."
        ),
    ),
)


def _wider(name: str, title: str, source: str) -> ArmClass:
    """Make the class that takes each figure from the industrial class in which it is wider."""
    return ArmClass(
        name,
        title,
        shift_m=max(one.shift_m for one in _INDUSTRIAL),
        turn_rad=max(one.turn_rad for one in _INDUSTRIAL),
        repeatability_m=max(one.repeatability_m for one in _INDUSTRIAL),
        source=source,
    )


ARM_CLASSES: dict[str, ArmClass] = {
    one.name: one
    for one in (
        *_INDUSTRIAL,
        ArmClass(
            SEVEN,
            "an arm of seven joints",
            shift_m=4e-3,
            turn_rad=7e-3,
            repeatability_m=0.1e-3,
            source=(
                "Franzese, Spahn, Kober and Della Santina (2025) measure errors of the order of 10 mm on "
                "Franka, KUKA and Kinova arms with their nominal kinematics; owners of a Franka report 3.5 "
                "to 10 mm (libfranka, 2019 to 2025), and on a public set of 114 views of a Franka Research 3 "
                "(Nadeau 2024) positions are missed by 6 mm. No orientation is published: in that set it is "
                "off by 6.8 mrad per axis, beside the arm that its joints tell, the base registered."
            ),
        ),
        ArmClass(
            _SERVO,
            "a low-cost arm with servos",
            shift_m=8e-3,
            turn_rad=25e-3,
            repeatability_m=1e-3,
            source=(
                "Trossen Robotics states an accuracy of 5 to 8 mm and a repeatability of 1 mm for its arms "
                "with Dynamixel servos; owners of an SO-101 report 10 to 15 mm (LeRobot, 2026), and its tip "
                "sags by 5 to 50 mm (Robonine 2026); a myCobot 280 stands 1.1 to 1.9 degrees off (Elephant "
                "Robotics' own tracker, 2025)."
            ),
        ),
        _wider(
            UNKNOWN,
            "an unknown arm",
            source=(
                "Nobody told which arm this is: of the figures of industrial arms of six joints, Universal "
                "Robots among them, the wider ones are taken. An arm of seven joints or with servos misses "
                "by more."
            ),
        ),
    )
}
"""Name → class, those with the smallest errors first and what is taken for an unknown arm last."""

CLASSES_HELP = "Class of the arm, by which its own error (1σ per axis) is looked up: " + ", ".join(
    f"{one.name} ({1e3 * one.shift_m:g} mm, {1e3 * one.turn_rad:g} mrad)" for one in ARM_CLASSES.values()
)
"""What `--arm-class` says of itself."""

_NAMES = {
    _SERVO: """
        so 100, so 101, so 102, so arm 100, so arm 101, so arm 102, so arm, koch, mycobot, mecharm,
        mypalletizer, x arm 1s, x arm 2.0, hiwonder, lewansoul, widowx, widowx 200, widowx 250, widowx
        250s, viperx, viperx #, viperx 300s, pincherx, pincherx #, reactorx, reactorx #, px #, rx #, wx
        #, wx 250s, vx #, vx 300s, interbotix, open manipulator, open manipulator x, dynamixel, braccio,
        dofbot, armpi, jetarm
        """,
    _UR: """
        universal robots, universal robot, ur 3, ur 3e, ur 5, ur 5e, ur 7e, ur 8, ur 8e, ur 10, ur 10e,
        ur 12e, ur 15, ur 16e, ur 18, ur 20, ur 30
        """,
    SEVEN: """
        franka, panda, fr 3, fer, iiwa, iiwa 7, iiwa 14, lwr, lwr 4, lbr med, x arm 7, sawyer, baxter,
        yumi, irb 14000, irb 14050, rizon, rizon 4, rizon 4s, rizon 10, wam, sia #d, sia #f, rm 75
        """,
    _SIX: """
        kuka, kr #, agilus, cybertech, quantec, iisy, abb, irb #, gofa, swifti, fanuc, lr mate, crx,
        yaskawa, motoman, gp #, stäubli, staubli, staeubli, tx #, tx #l, denso, cobotta, kawasaki,
        mitsubishi, comau, nachi, hyundai, doosan, techman, x arm, x arm 5, x arm 6, lite 6, jaka, aubo,
        puma, puma #
        """,
}
"""Class → names of its arms as makers, drivers and data sets write them, the more particular class first.

A space stands for a space, a hyphen, an underscore or nothing, `#` for a number.
"""


def _pattern(names: str) -> re.Pattern[str]:
    """Match one of the names as a whole word: `ur5e_robot` holds one, `blur5` none."""
    written = (re.escape(" ".join(name.split())) for name in names.split(","))
    one_of = "|".join(written).replace(r"\ ", "[-_ ]?").replace(r"\#", r"\d+")
    return re.compile(rf"(?<![^\W_])(?:{one_of})(?![^\W_])", re.IGNORECASE)


_PATTERNS = {name: _pattern(names) for name, names in _NAMES.items()}


def arm_class(model: str, told: str = "", joints: int | None = None) -> ArmClass:
    """Look up the class of an arm: what was told, else its model's name, else its number of joints.

    model: as a controller, a cell file or a recording names the arm; `unknown` and empty say nothing.
    told: the name of a class, as a person wrote it; empty: none was told.
    joints: how many the recorded poses have; None: none are recorded.
    An arm of seven joints is of no class of six, whatever its maker builds besides. What nothing tells is
    the class `unknown`. Raises UsageError (`choice`) where `told` is no class.
    """
    if told:
        require_choice("arm_class", told, ARM_CLASSES)
        return ARM_CLASSES[told]
    name = _class_of_model(model)
    if joints == 7 and name in (_SIX, UNKNOWN):
        return ARM_CLASSES[SEVEN]
    return ARM_CLASSES[name]


def _class_of_model(model: str) -> str:
    return next((name for name, pattern in _PATTERNS.items() if pattern.search(model)), UNKNOWN)
