"""`python urx_moves.py HOST`: python-urx moves an arm; what it saw, as JSON.

python-urx is of 2018. Two names that Python and NumPy have changed since are given back to it, nothing else.
"""

from __future__ import annotations

import collections
import collections.abc
import json
import sys

import numpy as np

vars(collections)["Iterable"] = collections.abc.Iterable
np.set_printoptions(legacy="1.25")

import urx  # noqa: E402

robot = urx.Robot(sys.argv[1])
seen: dict[str, object] = {}
try:
    robot.set_tcp((0, 0, 0.1, 0, 0, 0))
    robot.set_payload(0.5)
    joints = robot.getj()
    seen["joints"] = joints
    robot.movej([joints[0] + 0.1, *joints[1:]], acc=2.0, vel=1.0)
    seen["turned"] = robot.getj()[0] - joints[0]
    before = robot.getl()
    robot.translate((0, 0, -0.05), acc=1.0, vel=0.2)
    seen["translated"] = [b - a for a, b in zip(before, robot.getl(), strict=True)]
    robot.send_program("speedl([0, 0, 0.05, 0, 0, 0], 0.5, 5)")
    for _ in range(20):
        robot.secmon.wait()
        if robot.is_program_running():
            seen["streams"] = True
            break
    robot.stopl(0.5)
    robot.send_program("set_digital_out(1, True)")
    while not robot.get_digital_out(1):
        robot.secmon.wait()
    seen["version"] = robot.secmon._parser.version
finally:
    robot.close()
print("RESULT", json.dumps(seen))
