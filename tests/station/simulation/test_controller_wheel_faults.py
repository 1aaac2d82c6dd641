"""What goes wrong, as the unmodified ur_rtde wheel sees it: safety stops, other masters, broken links."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from station.simulation.launch import AdminClient, SimulatedController
from tests.patience import wait_until

pytestmark = pytest.mark.process
Start = Callable[..., SimulatedController]
Wheel = Callable[..., dict[str, Any]]

IN_MOTION = """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        control.moveJ(FAR, 0.5, 1.0, True)
        until(lambda: fastest(receive.getActualQd()) > 0.2)
"""


def test_a_protective_stop_is_not_unlocked_at_once(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        IN_MOTION
        + """
        dashboard = dashboard_client.DashboardClient(host)
        dashboard.connect()
        admin.ask("pstop")
        told(receive)
        result["state"] = [receive.getSafetyMode(), receive.getRobotMode(), receive.isProtectiveStopped(),
                           receive.isEmergencyStopped(), receive.getRuntimeState()]
        result["speed"] = fastest(receive.getActualQd())
        result["move"] = control.moveJ(NEAR, 0.5, 1.0)
        result["word"] = control.getAsyncOperationProgress()
        try:
            dashboard.unlockProtectiveStop()
        except RuntimeError as error:
            result["early"] = str(error)
        result["admin early"] = admin.ask("unlock")["unlocked"]
        result["safetymode"] = dashboard.safetymode()
        """,
    )
    assert result["state"] == [3, 7, True, False, 4]
    assert result["speed"] == 0.0 and result["move"] is False and result["word"] == 0
    assert "5s" in result["early"] and result["admin early"] is False
    assert "PROTECTIVE_STOP" in result["safetymode"]


@pytest.mark.parametrize(("model", "mode"), [("UR10", 3), ("UR10e", 5)])
def test_emergency_stop_and_recovery(controller: Start, wheel: Wheel, model: str, mode: int) -> None:
    result = wheel(
        controller(model),
        IN_MOTION
        + """
        admin.ask("estop")
        told(receive)
        result["state"] = [receive.getSafetyMode(), receive.getRobotMode(), receive.isEmergencyStopped(),
                           control.isProgramRunning()]
        result["speed"] = fastest(receive.getActualQd())
        result["move"] = control.moveJ(NEAR, 0.5, 1.0)
        admin.ask("estop", on=False)
        told(receive)
        result["released"] = [receive.getSafetyMode(), receive.getRobotMode()]
        admin.ask("run")
        control.reuploadScript()
        until(control.isProgramRunning)
        result["moves again"] = control.moveJ(NEAR, 2.0, 4.0)
        """,
    )
    assert result["state"] == [7, mode, True, False]
    assert result["speed"] == 0.0 and result["move"] is False
    assert result["released"] == [1, 3] and result["moves again"] is True


def test_a_safeguard_stop_pauses_until_play(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        IN_MOTION
        + """
        admin.ask("safeguard")
        until(lambda: fastest(receive.getActualQd()) < 1e-4)
        result["held"] = [receive.getSafetyMode(), receive.getRuntimeState(), fastest(receive.getActualQd())]
        admin.ask("safeguard", on=False)
        told(receive)
        result["cleared"] = [receive.getSafetyMode(), receive.getRuntimeState(), admin.ask("state")["moving"]]
        result["play"] = admin.ask("play")["playing"]
        until(lambda: fastest(receive.getActualQd()) > 0.2)
        """,
    )
    assert result["held"][:2] == [5, 4] and result["held"][2] < 1e-4
    assert result["cleared"] == [1, 4, True] and result["play"] is True


def test_power_off_and_program_stop_from_the_pendant(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        IN_MOTION
        + """
        admin.ask("stop_program")
        until(lambda: fastest(receive.getActualQd()) < 1e-4)
        result["stopped"] = [receive.getRuntimeState(), fastest(receive.getActualQd())]
        result["move"] = control.moveJ(NEAR, 0.5, 1.0)
        control.reuploadScript()
        until(control.isProgramRunning)
        result["again"] = control.moveJ(HOME, 2.0, 4.0)
        admin.ask("power_off")
        told(receive)
        result["off"] = [receive.getRobotMode(), receive.getRuntimeState(), receive.getRobotStatus()]
        """,
    )
    assert result["stopped"][0] == 1 and result["stopped"][1] < 1e-4
    assert result["move"] is False and result["again"] is True
    assert result["off"] == [3, 1, 0]


def test_the_watchdog_stops_a_silent_client(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        result["set"] = control.setWatchdog(10.0)
        control.moveJ(FAR, 0.3, 1.0, True)
        for _ in range(20):
            control.kickWatchdog()
            time.sleep(0.03)
        result["kicked"] = [control.isProgramRunning(), fastest(receive.getActualQd())]
        until(lambda: not control.isProgramRunning() and fastest(receive.getActualQd()) < 1e-4)
        result["short"] = FAR[0] - receive.getActualQ()[0]
        """,
    )
    assert result["set"] and result["kicked"][0] and result["kicked"][1] > 0.2
    assert result["short"] > 0.1


def test_local_control_refuses_the_wheel(controller: Start, wheel: Wheel) -> None:
    running = controller("UR10e", options=("--local",))
    result = wheel(
        running,
        """
        try:
            rtde_control.RTDEControlInterface(host)
        except RuntimeError as error:
            result["refused"] = str(error)
        dashboard = dashboard_client.DashboardClient(host)
        dashboard.connect()
        result["remote"] = dashboard.isInRemoteControl()
        try:
            dashboard.stop()
        except RuntimeError as error:
            result["stop"] = str(error)
        admin.ask("remote", on=True)
        try:
            dashboard.stop()
        except RuntimeError as error:
            result["same connection"] = str(error)
        dashboard.disconnect()
        dashboard.connect()
        dashboard.stop()
        control = rtde_control.RTDEControlInterface(host)
        result["running"] = control.isProgramRunning()
        admin.ask("remote", on=False)
        until(lambda: not control.isProgramRunning())
        """,
    )
    assert "remote control" in result["refused"].lower()
    assert result["remote"] is False and "Remote Control" in result["stop"]
    assert "Remote Control" in result["same connection"]
    assert result["running"] is True


def test_a_killed_client_leaves_the_arm_moving_and_the_registers_free(
    controller: Start, wheel: Wheel, admin: Callable[[SimulatedController], AdminClient]
) -> None:
    """Why a driver needs the watchdog: without it the program runs on alone."""
    running = controller("UR10")
    wheel(
        running,
        "rtde_control.RTDEControlInterface(host).moveJ(FAR, 1.0, 2.0, True)\nos.kill(os.getpid(), 9)",
        ends=False,
    )
    ask = admin(running)
    state = ask.ask("state")
    assert state["moving"] and state["runtime_state"] == "PLAYING" and state["claims"] == []
    wait_until(lambda: not ask.ask("state")["moving"])
    assert ask.ask("state")["target_joints_rad"][0] == pytest.approx(1.2)


def test_a_second_client_and_registers_of_a_field_bus(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        """
        control = rtde_control.RTDEControlInterface(host)
        try:
            rtde_control.RTDEControlInterface(host)
        except RuntimeError as error:
            result["second"] = str(error)
        result["first"] = control.isSteady()
        control.stopScript()
        control.disconnect()
        until(lambda: not admin.ask("state")["claims"])
        admin.ask("in_use", inputs=["input_int_register_0"])
        Control = rtde_control.RTDEControlInterface
        control = Control(host, 125.0, Control.FLAG_UPLOAD_SCRIPT | Control.FLAG_UPPER_RANGE_REGISTERS)
        result["upper"] = [control.isSteady(), control.moveJ(NEAR, 2.0, 4.0)]
        """,
    )
    assert "in use" in result["second"] and result["first"] is True
    assert result["upper"] == [True, True]
