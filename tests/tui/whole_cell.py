"""From an empty home to an installed calibration by keys alone: python -m tests.tui.whole_cell FOLDER

Runs where there is no network but `lo`: a simulated controller at an address of its own, a GigE camera, and
`station new` in a terminal. Prints what a person did and what came of it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

from calibrate.files.install import installed_calibration
from calibrate.geometry import difference
from station.cell.config_file import load_config
from station.cell.layout import guess_matrix
from station.simulation.launch import start_controller, start_gige
from station.simulation.truth import write_truth
from tests.conftest import check_allow_list
from tests.station.operate.guided_views import guided_joints
from tests.tui.terminal import ScreenProcess
from tests.tui.test_new_cell import other_cell

HOST = "127.44.5.6"


class Person:
    """Presses keys, and counts them."""

    def __init__(self, screen: ScreenProcess) -> None:
        self.screen, self.keys = screen, 0

    def press(self, *keys: str) -> None:
        self.keys += len(keys)
        self.screen.press(*keys)

    def sees(self, pattern: str) -> None:
        self.screen.wait_for(pattern, 240.0)
        time.sleep(0.5)


def main(folder: Path) -> None:
    home = folder / "home"
    (folder / "run").mkdir(parents=True, mode=0o700)
    home.mkdir()
    os.environ |= {"HOME": str(home), "XDG_RUNTIME_DIR": str(folder / "run")}
    for name in ("XDG_CONFIG_HOME", "XDG_STATE_HOME"):
        os.environ.pop(name, None)
    truth, truth_file = other_cell(), folder / "truth.json"
    write_truth(truth, truth_file)
    with (
        start_controller(truth.robot_model, host=HOST, truth=truth_file) as controller,
        start_gige(HOST, truth=truth_file, serial="KJ0042"),
    ):
        begun_s = time.monotonic()
        screen = ScreenProcess(folder / "none", 120, 36, command=("new",))
        person = Person(screen)
        try:
            person.sees("Which robot")
            person.press(*HOST, "enter")
            person.sees("This camera")
            person.press("enter")
            person.sees("Where is the camera")
            person.press("enter")
            person.sees("Which board")
            person.press(*"8x5 23", "enter")
            person.sees("40 corners")
            person.press("enter")
            person.sees("✓○○○")
            for count, joints in enumerate(guided_joints(truth)[1:4], start=2):
                with controller.admin() as admin:
                    admin.ask("hand_move", path=[joints.tolist()], speed_rad_s=0.5)
                person.sees("✓" * count + "○" if count < 4 else "Write the file")
            person.press("enter")
            person.sees("Open this cell")
            person.press("enter")
            person.sees("F12")
            person.sees("UR10.*NORMAL|NORMAL.*UR10")
            person.press("2", "n")
            person.sees("25 poses +expected at the end")
            person.press("f5")
            person.sees("Is everybody out")
            person.press("tab", "enter")
            person.sees("F9 +Solve")
            person.press("f9")
            person.sees("gates passed")
            person.press("i")
            person.sees("Install this calibration")
            person.press("tab", "enter")
            person.sees("INSTALLED")
            check_allow_list(HOST)
        finally:
            screen.end()
            end_daemon(home)
    spent_s = time.monotonic() - begun_s
    config, _ = load_config(home / ".config/calibration-station/station.yaml")
    assert config.camera_guess is not None
    off = difference(guess_matrix(config.camera_guess), np.array(truth.camera_mount))
    installed = installed_calibration(home / ".local/state/calibration-station")
    left = difference(installed.transform.matrix, np.array(truth.camera_mount))
    told = {
        "keys": person.keys,
        "minutes": spent_s / 60,
        "off_m": float(np.linalg.norm(off[:3])),
        "sigma_m": config.camera_guess.sigma_m,
        "installed_off_m": float(np.linalg.norm(left[:3])),
        "chi2": float(left @ np.linalg.solve(np.array(installed.covariance), left)),
    }
    print(json.dumps(told))


def end_daemon(home: Path) -> None:
    """It goes on without its screen: whoever runs with this home as its own is ours."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            ours = f"HOME={home}".encode() in (process / "environ").read_bytes().split(b"\0")
            serves = b"serve" in (process / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if ours and serves:
            os.kill(int(process.name), signal.SIGTERM)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
