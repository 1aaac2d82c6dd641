"""Tells the pose of a Universal Robots arm, reading alone: `python3 tell_ur.py 192.168.1.10 | station post`.

Needs `ur_rtde`. For an arm that the station may not move: guide it by Freedrive. The controller tells the
tool centre point: set it to zero on the pendant (Installation → TCP).
"""

import json
import sys
import time

from rtde_receive import RTDEReceiveInterface

PERIOD_S = 0.02


def main(host: str) -> None:
    arm = RTDEReceiveInterface(host)
    print(json.dumps({"source": "live", "convention": "ur-rotvec"}), flush=True)
    while arm.isConnected():
        told = {
            "base_from_flange": arm.getActualTCPPose(),
            "joints_rad": arm.getActualQ(),
            "t": arm.getTimestamp(),
        }
        print(json.dumps(told), flush=True)
        time.sleep(PERIOD_S)


if __name__ == "__main__":
    main(sys.argv[1])
