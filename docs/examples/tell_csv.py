"""Tells the poses that another program appends: `python3 tell_csv.py poses.csv live | station post`.

Each line: x, y, z in metres, a quaternion x, y, z, w, then the joints in radians, if any. The time of a pose
is when its line is seen, so the other program must write each at once. State what it writes: `live` for an
arm that stands there now, else `playback` or `simulated`, which never install on a real cell.
"""

import json
import sys
import time
from pathlib import Path

LOOK_S = 0.005


def main(path: str, source: str) -> None:
    with Path(path).open() as file:
        file.seek(0, 2)  # what was there before is old
        print(json.dumps({"source": source}), flush=True)
        rest = ""
        while True:
            rest += file.read()
            *lines, rest = rest.split("\n")
            for line in lines[-1:]:
                numbers = [float(number) for number in line.split(",")]
                told = {"base_from_flange": numbers[:7], "t": time.monotonic()}
                if numbers[7:]:
                    told["joints_rad"] = numbers[7:]
                print(json.dumps(told), flush=True)
            time.sleep(LOOK_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
