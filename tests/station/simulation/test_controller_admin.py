"""The admin port: where the arm truly was, hands on the arm, clocks that drift."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest

from station.simulation.launch import AdminClient
from tests.codes import raises
from tests.patience import wait_until

pytestmark = pytest.mark.process
HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]


def test_truth_is_where_the_arm_was_at_that_host_time(controller, rtde, admin) -> None:
    running = controller("UR10e")
    ask = admin(running)
    client = rtde(running)
    client.start("timestamp", "actual_q")
    ask.ask("hand_move", path=[[1.0, *HOME[1:]]], speed_rad_s=1.0)
    samples = [client.sample() for _ in range(500)]
    zero_ns = ask.ask("state")["controller_zero_monotonic_ns"]
    moving = [s for s in samples if 0.1 < s["actual_q"][0] < 0.9]
    assert len(moving) > 100
    for sample in moving[::20]:
        at_ns = zero_ns + round(sample["timestamp"] * 1e9)
        truth = ask.ask("truth", at_monotonic_ns=at_ns)
        assert truth["joints_rad"] == pytest.approx(sample["actual_q"], abs=1e-9)
        between = ask.ask("truth", at_monotonic_ns=at_ns + 1_000_000)
        assert between["joints_rad"][0] > sample["actual_q"][0]
    base_from_flange = np.array(truth["base_from_flange"])
    assert base_from_flange.shape == (4, 4) and np.linalg.det(base_from_flange[:3, :3]) == pytest.approx(1.0)


def test_truth_waits_for_the_near_future_and_refuses_the_rest(controller, admin) -> None:
    ask = admin(controller("UR10"))
    soon_ns = time.monotonic_ns() + 100_000_000
    assert ask.ask("truth", at_monotonic_ns=soon_ns)["at_monotonic_ns"] == soon_ns
    assert time.monotonic_ns() >= soon_ns
    with raises("simulation-refused"):
        ask.ask("truth", at_monotonic_ns=1)


def test_the_arm_is_led_by_hand_only_when_it_is_free(controller, admin) -> None:
    ask = admin(controller("UR10"))
    ask.ask("foreign")
    wait_until(lambda: ask.ask("state")["runtime_state"] == "PLAYING")
    with raises("simulation-refused"):
        ask.ask("hand_move", path=[HOME])
    ask.ask("stop_program")
    corners = [[0.1, *HOME[1:]], [0.1, -1.4, *HOME[2:]]]
    assert ask.ask("hand_move", path=corners, speed_rad_s=2.0)["length_rad"] == pytest.approx(0.1 + 0.1708)
    wait_until(lambda: not ask.ask("state")["moving"])
    assert ask.ask("state")["target_joints_rad"] == pytest.approx(corners[1])


def test_the_admin_port_explains_itself_and_survives_nonsense(controller, admin) -> None:
    running = controller("UR10")
    ask = admin(running)
    commands = ask.ask("help")["commands"]
    assert all(commands.values()) and {"pstop", "truth", "drop", "hand_move"} <= set(commands)
    for nonsense, words in (
        ({"cmd": "explode"}, "lists the names"),
        ({"cmd": "slider", "fraction": 3}, "$.fraction"),
        ({"cmd": "slider", "fraction": float("nan")}, "lists the names"),
        ({"cmd": "hand_move", "path": [HOME], "speed_rad_s": 0}, "$.speed_rad_s"),
        ({"cmd": "tcp", "pose": "here"}, "$.pose"),
        ({"cmd": "hand_move"}, "`path`"),
        ({"cmd": "slider", "share": 1}, "`share`"),
        ({"cmd": "tcp", "pose": [1, 2]}, "$.pose"),
        ({"cmd": "drop", "ports": ["moon"]}, "not ['moon']"),
    ):
        with raises("simulation-refused") as refusal:
            ask.ask(**nonsense)
        assert words in str(refusal.value)
    with socket.create_connection((running.host, 29990), 3) as link:
        link.sendall(b"[1]\n")
        assert b'"ok": false' in link.recv(1000)
    with AdminClient(running.host) as other:
        other.ask("state")


def test_the_controller_clock_drifts_as_told(controller, rtde, admin, tmp_path) -> None:
    import msgspec

    truth = {
        "scene": "test", "seed": 3, "mount": "eye-in-hand", "robot_model": "UR10",
        "board": {"kind": "chessboard", "columns": 7, "rows": 6, "square_m": 0.025},
        "camera": {"width": 640, "height": 512},
        "camera_mount": np.eye(4).tolist(), "board_place": np.eye(4).tolist(),
        "start_joints_rad": [0.1, -1.4, 1.4, -1.5, -1.5, 0.2], "robot_sigma_m": 1e-3,
    }  # fmt: skip
    path = tmp_path / "truth.json"
    path.write_bytes(msgspec.json.encode(truth))
    running = controller("UR10", truth=path)
    ask = admin(running)
    ask.ask("truth", at_monotonic_ns=time.monotonic_ns() + 50_000_000)
    state = ask.ask("state")
    assert state["joints_rad"] == pytest.approx(truth["start_joints_rad"])
    assert any(ask.ask("truth")["miss"])
    elapsed_s = (state["timestamp_monotonic_ns"] - state["controller_zero_monotonic_ns"]) / 1e9
    assert state["timestamp_s"] / elapsed_s == pytest.approx(1.0, rel=1e-6)
