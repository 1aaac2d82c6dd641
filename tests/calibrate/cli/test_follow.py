"""`calibrate follow`, and the launch file that sends what it prints: with ROS's modules as fakes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from calibrate.files.install import install, set_validity
from calibrate.files.validity import ValidityReason, ValidityState
from tests.calibrate.calling import run
from tests.patience import PATIENCE_S

FAKES = {
    "rclpy/__init__.py": """
import sys
class Stamp:
    def now(self): return self
    def to_msg(self): return "now"
class Logger:
    def info(self, text): print("info", text, file=sys.stderr, flush=True)
    def error(self, text): print("error", text, file=sys.stderr, flush=True)
class Node:
    def __init__(self, name): self.name = name
    def get_logger(self): return Logger()
    def get_clock(self): return Stamp()
def init(): pass
create_node = Node
""",
    "geometry_msgs/__init__.py": "",
    "geometry_msgs/msg.py": """
from types import SimpleNamespace as Plain
def TransformStamped():
    place = Plain(translation=Plain(x=0.0, y=0.0, z=0.0), rotation=Plain(x=0.0, y=0.0, z=0.0, w=1.0))
    return Plain(header=Plain(stamp=None, frame_id=""), child_frame_id="", transform=place)
""",
    "tf2_ros/__init__.py": "",
    "tf2_ros/static_transform_broadcaster.py": """
import json
class StaticTransformBroadcaster:
    def __init__(self, node): self.node = node
    def sendTransform(self, message):
        print(json.dumps(message, default=vars), flush=True)
""",
}


MakeFile = Callable[..., Path]


@pytest.fixture
def root(tmp_path: Path, make_file: MakeFile) -> Path:
    install(make_file(), tmp_path / "cell")
    return tmp_path / "cell"


def lines(process: subprocess.Popen[str]) -> Iterator[Any]:
    assert process.stdout is not None
    return (json.loads(line) for line in process.stdout)


@pytest.fixture
def ended() -> Iterator[list[subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()
        for pipe in filter(None, (process.stdout, process.stderr)):
            pipe.close()


def started(ended: list[subprocess.Popen[str]], *words: object, **more: Any) -> subprocess.Popen[str]:
    process = subprocess.Popen([*map(str, words)], stdout=subprocess.PIPE, text=True, **more)
    ended.append(process)
    return process


def follow(ended: list[subprocess.Popen[str]], root: Path) -> subprocess.Popen[str]:
    command = (sys.executable, "-m", "calibrate.cli", "follow", "--root", root, "--poll-s", "0.02")
    return started(ended, *command)


def test_every_change_is_one_line(ended: list[subprocess.Popen[str]], root: Path) -> None:
    told = lines(follow(ended, root))
    first = next(told)
    assert (first["event"], first["version"], first["validity"]["state"]) == ("installed", 1, "valid")
    assert first["result"]["child_frame"] == "camera" and first["intrinsics"]["width"] > 0
    set_validity(root, ValidityState.IN_DOUBT, ValidityReason("drift-check", "moved"))
    doubted = next(told)
    assert (doubted["event"], doubted["validity"]["reason"]["code"]) == ("in-doubt", "drift-check")
    (root / "calibrations/current").unlink()
    gone = next(told)
    assert (gone["event"], gone["version"], gone["result"]) == ("unreadable", None, None)


def test_it_ends_when_nobody_reads(ended: list[subprocess.Popen[str]], root: Path) -> None:
    process = follow(ended, root)
    next(lines(process))
    assert process.stdout is not None
    process.stdout.close()
    assert process.wait(PATIENCE_S) == 0


def test_the_launch_file_sends_what_holds_and_nothing_else(
    ended: list[subprocess.Popen[str]], root: Path, tmp_path: Path, make_file: MakeFile
) -> None:
    for name, text in FAKES.items():
        (tmp_path / "ros" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "ros" / name).write_text(text)
    launch = tmp_path / "camera.launch.py"
    done = run("export", "--to", "ros-launch-follow", "--root", root, "-o", launch, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    node = started(
        ended,
        sys.executable,
        launch,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "ros")},
        stderr=subprocess.PIPE,
    )
    sent = lines(node)
    first = next(sent)
    assert (first["header"]["frame_id"], first["child_frame_id"]) == ("tool0", "camera_optical_frame")
    shown = json.loads(run("show", "--root", root, "--json", cwd=tmp_path).stdout)["result"]
    place = first["transform"]
    assert [place["translation"][axis] for axis in "xyz"] == shown["translation_m"]
    assert [place["rotation"][axis] for axis in "xyzw"] == shown["rotation_xyzw"]
    assert node.stderr is not None
    assert node.stderr.readline().split(":")[0] == "info calibration version 1"
    set_validity(root, ValidityState.IN_DOUBT, ValidityReason("drift-check", "moved"))
    assert node.stderr.readline().split(":")[0] == "error calibration version 1"
    install(make_file(0.001), root)
    assert next(sent)["transform"] != place
    assert node.stderr.readline().split(":")[0] == "info calibration version 2"
    node.send_signal(signal.SIGINT)
    assert node.wait(PATIENCE_S) == 0
