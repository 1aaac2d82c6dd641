"""`python pytransform3d_urdf.py URDF FROM TO`: frames of a URDF by pytransform3d, at postures from stdin.

Standard input: a JSON list of {joint: radians}; output: FROM_from_TO (4, 4) of each.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from pytransform3d.urdf import UrdfTransformManager

manager = UrdfTransformManager()
manager.load_urdf(Path(sys.argv[1]).read_text())
found = []
for posture in json.load(sys.stdin):
    for joint, angle in posture.items():
        manager.set_joint(joint, angle)
    found.append(manager.get_transform(sys.argv[3], sys.argv[2]).tolist())
print(json.dumps(found))
