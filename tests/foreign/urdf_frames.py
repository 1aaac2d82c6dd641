"""`urdf_frames.py LIBRARY URDF FROM TO`: frames of a URDF by somebody's library, at postures from stdin.

Standard input: a JSON list of {joint: radians}; output: FROM_from_TO (4, 4) of each.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

library, path, parent, child = sys.argv[1:]
found = []
if library == "pytransform3d":
    from pytransform3d.urdf import UrdfTransformManager

    manager = UrdfTransformManager()
    manager.load_urdf(Path(path).read_text())
    for posture in json.load(sys.stdin):
        for joint, angle in posture.items():
            manager.set_joint(joint, angle)
        found.append(manager.get_transform(child, parent).tolist())
else:
    from yourdfpy import URDF

    robot = URDF.load(path, load_meshes=False)
    for posture in json.load(sys.stdin):
        robot.update_cfg(posture)
        found.append(robot.get_transform(child, parent).tolist())
print(json.dumps(found))
