"""Tells the pose of a Franka arm: `python3 tell_franka.py 172.16.0.2 | station post`.

Needs `pylibfranka`. It only reads; guide the arm by its own buttons. O_T_EE is the end effector as set in
Desk, stored column by column: F_T_EE takes it back to the flange.
"""

import json
import sys
import time

import numpy as np
import pylibfranka

PERIOD_S = 0.02


def matrix(columns: list[float]) -> np.ndarray:
    return np.array(columns).reshape(4, 4, order="F")


def main(host: str) -> None:
    arm = pylibfranka.Robot(host, pylibfranka.RealtimeConfig.kIgnore)
    print(json.dumps({"source": "live"}), flush=True)
    while True:
        t, state = time.monotonic(), arm.read_once()
        base_from_flange = matrix(state.O_T_EE) @ np.linalg.inv(matrix(state.F_T_EE))
        told = {"base_from_flange": base_from_flange.tolist(), "joints_rad": list(state.q), "t": t}
        print(json.dumps(told), flush=True)
        time.sleep(PERIOD_S)


if __name__ == "__main__":
    main(sys.argv[1])
