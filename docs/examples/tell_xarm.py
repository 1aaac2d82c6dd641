"""Tells the pose of a UFACTORY xArm: `python3 tell_xarm.py 192.168.1.203 | station post`.

Needs `xarm-python-sdk`, which answers in millimetres and degrees: roll, pitch, yaw about fixed axes. Put the
arm into manual mode in UFACTORY Studio, and clear its TCP offset there: with one it tells the tool's pose.
"""

import json
import math
import sys
import time

from xarm.wrapper import XArmAPI

PERIOD_S = 0.02


def main(host: str) -> None:
    arm = XArmAPI(host)
    if any(arm.tcp_offset):
        sys.exit(f"TCP offset {arm.tcp_offset}: set it to zero in UFACTORY Studio")
    print(json.dumps({"source": "live", "convention": "xarm-rpy"}), flush=True)
    while True:
        t = time.monotonic()
        failed, pose = arm.get_position(is_radian=False)
        unread, angles = arm.get_servo_angle(is_radian=False)
        if not failed and not unread:
            joints = [math.radians(angle) for angle in angles[: arm.axis]]
            print(json.dumps({"base_from_flange": pose[:6], "joints_rad": joints, "t": t}), flush=True)
        time.sleep(PERIOD_S)


if __name__ == "__main__":
    main(sys.argv[1])
