"""What is said of a recording that has to be read in another way, and of views that count for nothing."""

from __future__ import annotations

import numpy as np

from calibrate.handeye.readings import Explanation, Reading
from calibrate.handeye.suspects import Suspect
from calibrate.views import ViewSet
from recordings.schema.messages import Mount

_COMPONENTS = ("x", "y", "z", "rotation about x", "rotation about y", "rotation about z")
_CONVENTIONS = {
    Reading.INVERSE_POSES: "flange_from_base in place of base_from_flange, or belonged to the other mounting",
    Reading.QUATERNION_ORDER: "quaternions in the order w, x, y, z in place of x, y, z, w",
    Reading.ROTATION_VECTOR_AS_ANGLES: "rotation vectors that were read as roll, pitch, yaw",
    Reading.ANGLES_AS_ROTATION_VECTOR: "roll, pitch, yaw that were read as rotation vectors",
    Reading.INVERSE_ROTATIONS: "inverse rotations beside right positions",
}


def explain_text(session: Explanation, views: ViewSet) -> str:
    """At most two sentences: how the recording reads, and what to do."""
    reading = session.reading
    if reading is Reading.AS_RECORDED:
        return (
            "No other reading of the recording explains it. Check that the robot poses belong to these "
            "pictures, and the mounting."
        )
    if reading in _CONVENTIONS:
        return (
            f"The views agree when the robot poses are {_CONVENTIONS[reading]}. "
            "Correct poses.csv or dataset.yaml and import again."
        )
    if reading is Reading.SHIFTED:
        return (
            f"Each picture belongs to the robot pose {abs(session.at)} "
            f"{'later' if session.at > 0 else 'earlier'}. Move the poses by that many rows and import again."
        )
    if reading is Reading.MIRRORED:
        return (
            "The pictures are mirrored. Switch the camera's mirroring (flip, reverse x) off and record again."
        )
    if reading is Reading.MILLIMETRES:
        wrong = "robot positions" if session.factor > 1 else "size of the squares"
        return f"The {wrong} are in millimetres. Write them in metres and import again."
    if reading is Reading.SQUARE_SIZE:
        return (
            f"The board's squares are {session.factor:.4g} times as large as configured. "
            "Measure the board, correct square_m and solve again with --square-mm."
        )
    if reading is Reading.FOCAL_LENGTH:
        return (
            f"The focal length is {session.factor:.3f} times the given one. "
            "Solve with --estimate-intrinsics, or calibrate the camera again."
        )
    return _change_text(session, views)


def _change_text(session: Explanation, views: ViewSet) -> str:
    view = views.views[session.at]
    where = f"from view {view.index + 1} ({view.name}) on"
    if session.reading is Reading.REFOCUSED:
        return (
            f"The camera's focal length is another one {where}: it was refocused or zoomed. "
            "Lock the lens and record again."
        )
    what = _moved(session.reading, views.mount)
    return (
        f"{what} {where}. Record again, or solve with --accept-move to use both parts "
        "(the result is that after the move)."
    )


def _moved(reading: Reading, mount: Mount) -> str:
    if reading is Reading.BOARD_MOVED:
        return (
            "The board was moved"
            if mount == "eye-in-hand"
            else "The board was moved on the flange, or the TCP was changed,"
        )
    if mount == "eye-in-hand":
        return "The TCP was changed, or the camera moved on its mount,"
    return "The camera or the robot's base was moved"


def suspect_text(suspect: Suspect, views: ViewSet) -> str:
    """How a view contradicts the others, with its cause where the data name one."""
    apart = f"{suspect.residual_m * 1e3:.2f} mm, {np.degrees(suspect.residual_rad):.2f}°"
    if suspect.other is not None:
        other = views.views[suspect.other]
        return f"The picture belongs to the robot pose of view {other.index + 1} ({other.name})."
    if suspect.number is not None:
        component = _COMPONENTS[suspect.number]
        slip = f"{suspect.slip * 1e3:.2f} mm" if suspect.number < 3 else f"{np.degrees(suspect.slip):.2f}°"
        return f"Only {component} in base is off, by {slip}; the other five numbers of its pose agree."
    return f"Robot pose and picture differ by {apart} from what all other views say."
