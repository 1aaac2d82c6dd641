"""The unmodified ur_rtde wheel against the simulated controller: every fault a driver must survive."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

from station.simulation.admin import AdminClient
from station.simulation.launch import SimulatedController

pytestmark = pytest.mark.process
Start = Callable[..., SimulatedController]
Wheel = Callable[..., dict[str, Any]]


@pytest.mark.parametrize(("model", "rate"), [("UR10", 125), ("UR10e", 500)])
def test_the_wheel_reads_moves_and_asks(controller: Start, wheel: Wheel, model: str, rate: int) -> None:
    result = wheel(
        controller(model, time_scale=4),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        result["start"] = receive.getActualQ()
        result["modes"] = [receive.getRobotMode(), receive.getSafetyMode(), receive.getRuntimeState()]
        result["steady"] = control.isSteady()
        result["moveJ"] = control.moveJ(NEAR, 1.0, 2.0)
        until(lambda: near(receive.getActualQ(), NEAR))
        result["setTcp"] = control.setTcp([0, 0, 0.1, 0, 0, 0])
        result["offset"] = control.getTCPOffset()
        time.sleep(0.02)
        pose = receive.getActualTCPPose()
        result["ik"] = control.getInverseKinematics(pose)
        result["has"] = control.getInverseKinematicsHasSolution(pose)
        result["has not"] = control.getInverseKinematicsHasSolution([3, 0, 0, 0, 0, 0])
        result["fk"] = control.getForwardKinematics(NEAR, [0, 0, 0.1, 0, 0, 0])
        result["pose"] = pose
        goal = list(pose)
        goal[2] += 0.05
        result["moveL"] = control.moveL(goal, 0.1, 0.5)
        result["goal"] = goal
        time.sleep(0.3)
        result["reached"] = receive.getActualTCPPose()
        result["within"] = [control.isPoseWithinSafetyLimits(goal), control.isJointsWithinSafetyLimits(HOME)]
        first = receive.getTimestamp()
        began = time.monotonic()
        time.sleep(0.5)
        result["clock"] = (receive.getTimestamp() - first) / (time.monotonic() - began)
        result["step"] = control.getStepTime()
        """,
    )
    home = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]
    near = [0.2, -1.5, 1.5, -1.5, -1.5, 0.1]
    assert result["start"] == pytest.approx(home)
    assert result["modes"] == [7, 1, 2]
    assert result["steady"] and result["moveJ"] and result["setTcp"] and result["moveL"]
    assert result["offset"] == pytest.approx([0, 0, 0.1, 0, 0, 0])
    assert result["ik"] == pytest.approx(near, abs=1e-6)
    assert result["has"] is True and result["has not"] is False
    assert result["fk"] == pytest.approx(result["pose"], abs=1e-6)
    assert result["reached"] == pytest.approx(result["goal"], abs=1e-6)
    assert result["within"] == [True, True]
    assert result["clock"] == pytest.approx(1.0, abs=0.1)


def test_asynchronous_moves_paths_and_stops(controller: Start, wheel: Wheel) -> None:
    running = controller("UR10e")
    result = wheel(
        running,
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        began = time.monotonic()
        result["accepted"] = control.moveJ(FAR, 1.0, 2.0, True)
        result["call"] = time.monotonic() - began
        until(lambda: control.getAsyncOperationProgress() >= 0)
        time.sleep(0.3)
        result["moving"] = fastest(receive.getActualQd())
        control.stopJ(5.0, False)
        time.sleep(0.15)
        result["stopped"] = fastest(receive.getActualQd())
        result["short"] = FAR[0] - receive.getActualQ()[0]
        result["finished"] = finished(control)
        path = [[*NEAR, 2.0, 4.0, 0.0], [*HOME, 2.0, 4.0, 0.0], [*NEAR, 2.0, 4.0, 0.0]]
        result["path"] = control.moveJ(path, True)
        seen = []
        until(lambda: seen.append(control.getAsyncOperationProgress()) or max(seen) >= 1, 6.0)
        until(lambda: seen.append(control.getAsyncOperationProgress()) or seen[-1] < 0, 6.0)
        result["progress"] = sorted(set(seen))
        time.sleep(0.15)
        result["at"] = receive.getActualQ()
        control.moveJ(FAR, 1.0, 2.0, True)
        time.sleep(0.2)
        result["replaced"] = control.moveJ(NEAR, 2.0, 4.0, True)
        until(lambda: finished(control) and near(receive.getActualQ(), NEAR))
        control.stopScript()
        result["running"] = control.isProgramRunning()
        """,
    )
    assert result["accepted"] and result["call"] < 0.1
    assert result["moving"] > 0.2 and result["stopped"] < 1e-3 and result["short"] > 0.3
    assert result["finished"] and result["path"]
    assert {0, 1, 2} <= set(result["progress"])
    assert result["at"] == pytest.approx([0.2, -1.5, 1.5, -1.5, -1.5, 0.1], abs=1e-6)
    assert result["replaced"] and result["running"] is False


def test_the_wheel_copes_with_slow_inputs_and_a_protective_stop_that_ends_the_program(
    controller: Start, wheel: Wheel
) -> None:
    result = wheel(
        controller("UR10", options=("--input-delay", "3", "--protective-stop-ends-program")),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        began = time.monotonic()
        result["steady"] = control.isSteady()
        result["round trip"] = time.monotonic() - began
        result["move"] = control.moveJ(NEAR, 2.0, 4.0)
        result["accepted"] = control.moveJ(FAR, 0.5, 1.0, True)
        time.sleep(0.4)
        control.stopJ(5.0)
        result["stopped"] = receive.getActualQ()[0] < FAR[0] - 0.2
        admin.ask("pstop")
        time.sleep(0.05)
        result["state"] = [receive.getRuntimeState(), receive.isProtectiveStopped()]
        """,
    )
    assert result["steady"] and result["move"] and result["accepted"] and result["stopped"]
    assert result["round trip"] > 3 * 0.008
    assert result["state"] == [1, True]


def test_protective_stop_needs_five_seconds_an_unlock_and_a_new_script(
    controller: Start, wheel: Wheel
) -> None:
    result = wheel(
        controller("UR10"),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        dashboard = dashboard_client.DashboardClient(host)
        dashboard.connect()
        control.moveJ(FAR, 0.5, 1.0, True)
        time.sleep(0.4)
        admin.ask("pstop")
        time.sleep(0.05)
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
        time.sleep(5.0)
        dashboard.unlockProtectiveStop()
        time.sleep(0.05)
        result["after"] = [receive.getSafetyMode(), control.isProgramRunning()]
        control.reuploadScript()
        until(control.isProgramRunning)
        result["moves again"] = control.moveJ(NEAR, 2.0, 4.0)
        """,
    )
    assert result["state"] == [3, 7, True, False, 4]
    assert result["speed"] == 0.0 and result["move"] is False and result["word"] == 0
    assert "5s" in result["early"] and result["admin early"] is False
    assert "PROTECTIVE_STOP" in result["safetymode"]
    assert result["after"] == [1, False] and result["moves again"] is True


@pytest.mark.parametrize(("model", "mode"), [("UR10", 3), ("UR10e", 5)])
def test_emergency_stop_and_recovery(controller: Start, wheel: Wheel, model: str, mode: int) -> None:
    result = wheel(
        controller(model),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        control.moveJ(FAR, 0.5, 1.0, True)
        time.sleep(0.3)
        admin.ask("estop")
        time.sleep(0.05)
        result["state"] = [receive.getSafetyMode(), receive.getRobotMode(), receive.isEmergencyStopped(),
                           control.isProgramRunning()]
        result["speed"] = fastest(receive.getActualQd())
        result["move"] = control.moveJ(NEAR, 0.5, 1.0)
        admin.ask("estop", on=False)
        time.sleep(0.05)
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
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        control.moveJ(NEAR, 0.3, 1.0, True)
        time.sleep(0.2)
        admin.ask("safeguard")
        time.sleep(0.4)
        result["held"] = [receive.getSafetyMode(), receive.getRuntimeState(), fastest(receive.getActualQd())]
        admin.ask("safeguard", on=False)
        time.sleep(0.1)
        result["cleared"] = [receive.getSafetyMode(), receive.getRuntimeState(), admin.ask("state")["moving"]]
        result["play"] = admin.ask("play")["playing"]
        until(lambda: near(receive.getActualQ(), NEAR))
        """,
    )
    assert result["held"][:2] == [5, 4] and result["held"][2] < 1e-4
    assert result["cleared"] == [1, 4, True] and result["play"] is True


def test_power_off_and_program_stop_from_the_pendant(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        control.moveJ(FAR, 0.5, 1.0, True)
        time.sleep(0.3)
        admin.ask("stop_program")
        time.sleep(0.3)
        result["stopped"] = [receive.getRuntimeState(), fastest(receive.getActualQd())]
        began = time.monotonic()
        result["move"] = control.moveJ(NEAR, 0.5, 1.0)
        result["at once"] = time.monotonic() - began
        control.reuploadScript()
        until(control.isProgramRunning)
        result["again"] = control.moveJ(HOME, 2.0, 4.0)
        admin.ask("power_off")
        time.sleep(0.05)
        result["off"] = [receive.getRobotMode(), receive.getRuntimeState(), receive.getRobotStatus()]
        """,
    )
    assert result["stopped"][0] == 1 and result["stopped"][1] < 1e-4
    assert result["move"] is False and result["at once"] < 1.0 and result["again"] is True
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
        silent = time.monotonic()
        until(lambda: not control.isProgramRunning())
        result["noticed"] = time.monotonic() - silent
        time.sleep(0.3)
        result["speed"] = fastest(receive.getActualQd())
        """,
    )
    assert result["set"] and result["kicked"][0] and result["kicked"][1] > 0.2
    assert result["noticed"] < 0.25 and result["speed"] < 1e-4


def test_speed_slider_by_the_wheel_and_on_the_pendant(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        control = rtde_control.RTDEControlInterface(host)
        io = rtde_io.RTDEIOInterface(host)
        io.setSpeedSlider(0.25)
        time.sleep(0.3)
        result["fraction"] = receive.getTargetSpeedFraction()
        io.setStandardDigitalOut(3, True)
        io.setToolDigitalOut(1, True)
        time.sleep(0.05)
        result["outputs"] = receive.getActualDigitalOutputBits()
        control.moveJ(FAR, 1.0, 10.0, True)
        time.sleep(0.5)
        result["slow"] = fastest(receive.getTargetQd())
        admin.ask("slider", fraction=0.0)
        time.sleep(0.3)
        result["zero"] = [fastest(receive.getTargetQd()), control.getAsyncOperationProgress()]
        admin.ask("slider", fraction=1.0)
        until(lambda: near(receive.getActualQ(), FAR))
        """,
    )
    assert result["fraction"] == pytest.approx(0.25) and result["slow"] == pytest.approx(0.25, abs=0.01)
    assert result["outputs"] == 1 << 3 | 1 << 17
    assert result["zero"][0] < 1e-6 and result["zero"][1] == 0


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
        time.sleep(0.05)
        result["local again"] = control.isProgramRunning()
        """,
    )
    assert "remote control" in result["refused"].lower()
    assert result["remote"] is False and "Remote Control" in result["stop"]
    assert "Remote Control" in result["same connection"]
    assert result["running"] is True and result["local again"] is False


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
    deadline = time.monotonic() + 5
    while ask.ask("state")["moving"]:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert ask.ask("state")["target_joints_rad"][0] == pytest.approx(1.2)


def test_a_second_client_and_a_foreign_program(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        """
        admin.ask("foreign", name="palletising.urp")
        until(lambda: admin.ask("state")["program"] == "palletising.urp")
        dashboard = dashboard_client.DashboardClient(host)
        dashboard.connect()
        result["program"] = [dashboard.programState(), dashboard.running()]
        began = time.monotonic()
        control = rtde_control.RTDEControlInterface(host)
        result["took"] = time.monotonic() - began
        result["replaced"] = admin.ask("state")["program"]
        try:
            rtde_control.RTDEControlInterface(host)
        except RuntimeError as error:
            result["second"] = str(error)
        result["first"] = control.isSteady()
        """,
    )
    assert "PLAYING palletising.urp" in result["program"][0] and result["program"][1] is True
    assert result["took"] > 4.0 and result["replaced"] == "rtde_control"
    assert "in use" in result["second"] and result["first"] is True


def test_registers_owned_by_a_field_bus(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        """
        admin.ask("in_use", inputs=["input_int_register_0"])
        try:
            rtde_control.RTDEControlInterface(host)
        except RuntimeError as error:
            result["refused"] = str(error)
        Control = rtde_control.RTDEControlInterface
        control = Control(host, 125.0, Control.FLAG_UPLOAD_SCRIPT | Control.FLAG_UPPER_RANGE_REGISTERS)
        result["upper"] = [control.isSteady(), control.moveJ(NEAR, 2.0, 4.0)]
        """,
    )
    assert "in use" in result["refused"] and result["upper"] == [True, True]


@pytest.mark.parametrize("how", ["fin", "rst"])
def test_dropped_links(controller: Start, wheel: Wheel, how: str) -> None:
    result = wheel(
        controller("UR10"),
        f"""
        receive = rtde_receive.RTDEReceiveInterface(host)
        result["cut"] = admin.ask("drop", how="{how}", ports=["rtde"])["cut"]
        until(lambda: not receive.isConnected())
        result["last"] = receive.getActualQ()
        result["again"] = receive.reconnect()
        time.sleep(0.1)
        first = receive.getTimestamp()
        time.sleep(0.1)
        result["alive"] = receive.getTimestamp() > first
        """,
    )
    assert result["cut"] == 1 and len(result["last"]) == 6 and result["again"] and result["alive"]


def test_frozen_stalled_and_lost_data(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10"),
        """
        receive = rtde_receive.RTDEReceiveInterface(host)
        def advance():
            first = receive.getTimestamp()
            time.sleep(0.15)
            return receive.getTimestamp() - first
        result["live"] = advance()
        admin.ask("freeze")
        time.sleep(0.02)
        result["frozen"] = advance()
        admin.ask("freeze", on=False)
        result["thawed"] = advance()
        admin.ask("stall")
        time.sleep(0.02)
        result["stalled"] = [advance(), receive.isConnected()]
        time.sleep(2.8)
        result["noticed"] = receive.isConnected()
        """,
    )
    assert result["live"] == pytest.approx(0.15, abs=0.05) and result["frozen"] == 0.0
    assert result["thawed"] > 0.1 and result["stalled"] == [0.0, True] and result["noticed"] is False


def test_a_custom_script_runs_and_ends(controller: Start, wheel: Wheel) -> None:
    running = controller("UR10")
    result = wheel(
        running,
        """
        control = rtde_control.RTDEControlInterface(host)
        result["sent"] = control.sendCustomScriptFunction("beep", 'textmsg("beep")\\n')
        result["uploads"] = [e["verb"] for e in admin.ask("log")["entries"] if e["source"] == "upload"]
        """,
    )
    assert result["sent"] is True and "beep" in result["uploads"]


def test_the_log_has_every_command(controller: Start, wheel: Wheel) -> None:
    result = wheel(
        controller("UR10e"),
        """
        control = rtde_control.RTDEControlInterface(host)
        dashboard = dashboard_client.DashboardClient(host)
        dashboard.connect()
        control.moveJ(NEAR, 2.0, 4.0)
        dashboard.popup("hello")
        dashboard.powerOn()
        dashboard.brakeRelease()
        dashboard.closeSafetyPopup()
        control.stopJ(1.0)
        control.stopScript()
        log = admin.ask("log")
        result["counts"] = log["counts"]
        result["move"] = next(e for e in log["entries"] if e["verb"] == "moveJ")
        """,
    )
    for verb in ("popup", "power on", "brake release", "close safety popup"):
        assert result["counts"][f"dashboard: {verb}"] == 1
    assert result["counts"]["script: moveJ"] == 1 and result["counts"]["script: stopJ"] == 1
    assert result["counts"]["upload: rtde_control"] == 1
    assert result["move"]["arguments"][:6] == pytest.approx([0.2, -1.5, 1.5, -1.5, -1.5, 0.1])
