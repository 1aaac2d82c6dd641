"""Uploaded programs: URScript's interpreter joined to this controller's arm.

One table of builtins: what only computes (`script_pure`), registers, inputs, outputs and sockets
(`script_io`), what moves the arm (`script_motion`), and here what asks for its state or sets it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from math import inf

from station.simulation.controller.kinematics import forward
from station.simulation.controller.script_io import Sockets, Wait, inputs_and_outputs, registers
from station.simulation.controller.script_motion import ArmMotions
from station.simulation.controller.script_pure import PURE, pose_of, six, text_of
from station.simulation.controller.state import ControllerState
from station.simulation.controller.urscript import Pose, ScriptRun, ScriptRuntimeError
from station.simulation.controller.urscript_parser import Builtin

STEADY_RAD_S = 1e-3
_INSTALLATION = (
    "set_analog_inputrange", "set_input_actions_to_default", "set_runstate_outputs",
    "set_safety_mode_transition_hardness", "set_standard_analog_input_domain", "set_tool_analog_input_domain",
    "set_tool_communication", "set_tool_digital_output_mode", "set_tool_output_mode",
)  # fmt: skip
"""What a program that PolyScope exported sets first; without an effect here."""
_QUIET = frozenset({"sync", "sleep", "textmsg", "force", "tool_contact"})


class InterpretedProgram:
    """A text from a script port. Raises ScriptSyntaxError for one that this interpreter cannot run."""

    def __init__(self, robot: ControllerState, name: str, text: str) -> None:
        self.name, self.text = name, text
        self._robot = robot
        self._sockets = Sockets(robot)
        self._motions = ArmMotions(robot, lambda: self._run.thread)
        states = {**inputs_and_outputs(robot), **self._states()}
        builtins = {
            **PURE,
            **registers(robot),
            **self._sockets.builtins(),
            **{name: self._logged(name, builtin) for name, builtin in states.items()},
            **self._motions.builtins(),
        }
        self._run = ScriptRun(text, builtins)

    def _logged(self, name: str, builtin: Builtin) -> Builtin:
        """Wrap a function with each call in the log, unless it only asks or waits. Motions log themselves."""
        if name.startswith(("get_", "is_")) or name in _QUIET:
            return builtin

        @wraps(builtin)
        def logged(*arguments: object, **named: object) -> object:
            self._robot.journal.count("script", name)
            return builtin(*arguments, **named)

        return logged

    def step(self) -> bool:
        """One cycle; False when the program has ended. Raises ScriptRuntimeError, UnreachableError."""
        goes_on = self._run.step()
        self._motions.brake_orphan()
        return goes_on

    def end(self) -> None:
        """Kills every thread, closes what it opened and leaves its modes."""
        self._run.end()
        self._sockets.close()
        self._robot.freedrive = self._robot.force_mode = False

    # -- state ------------------------------------------------------------------------------------------

    def _states(self) -> dict[str, Builtin]:
        """Arguments have the names of the manual."""
        robot, arm, out = self._robot, self._robot.arm, self._robot.outputs

        def vector(name: str) -> Callable[[], list[float]]:
            return lambda: list(out.vector(name))

        def pose(name: str) -> Callable[[], Pose]:
            return lambda: Pose(out.vector(name))

        def mode(name: str, on: bool) -> Builtin:
            return lambda *_, **__: setattr(robot, name, on)

        def accepted(*_: object, **__: object) -> None:
            """Without an effect here."""

        return {
            "sync": self._sync,
            "sleep": self._sleep,
            "get_steptime": lambda: robot.dt_s,
            "is_steady": lambda: not arm.moving and max(map(abs, arm.actual_speed)) < STEADY_RAD_S,
            "get_actual_joint_positions": lambda: list(arm.actual),
            "get_joint_positions": lambda: list(arm.actual),
            "get_target_joint_positions": lambda: list(arm.command),
            "get_actual_joint_positions_history": lambda steps=0: list(robot.history.before(int(steps))),
            "get_actual_joint_speeds": lambda: list(arm.actual_speed),
            "get_target_joint_speeds": lambda: list(arm.command_speed),
            "get_joint_torques": vector("target_moment"),
            "get_joint_temp": lambda j: out.vector("joint_temperatures")[int(j)],
            "get_actual_tcp_pose": pose("actual_TCP_pose"),
            "get_target_tcp_pose": pose("target_TCP_pose"),
            "get_target_waypoint": pose("target_TCP_pose"),
            "get_actual_tcp_speed": pose("actual_TCP_speed"),
            "get_target_tcp_speed": pose("target_TCP_speed"),
            "get_actual_tool_flange_pose": lambda: pose_of(forward(robot.table, arm.actual)),
            "get_target_tool_flange_pose": lambda: pose_of(forward(robot.table, arm.command)),
            "get_tcp_offset": lambda: Pose(robot.tcp),
            "set_tcp": self._set_tcp,
            "get_target_payload": lambda: robot.payload_kg,
            "get_target_payload_cog": lambda: list(robot.payload_cog),
            "get_target_payload_inertia": lambda: list(robot.payload_inertia),
            "set_payload": self._set_payload,
            "set_target_payload": self._set_payload,
            "set_payload_mass": lambda m: self._set_payload(m),
            "set_payload_cog": lambda cog: self._set_payload(robot.payload_kg, cog),
            "set_gravity": lambda d: out.set("target_gravity", *map(float, d)),
            "get_tcp_force": vector("actual_TCP_force"),
            "force": lambda: out.get("tcp_force_scalar"),
            **dict.fromkeys(_INSTALLATION, accepted),
            "zero_ftsensor": accepted,
            "ft_rtde_input_enable": accepted,
            "enable_external_ft_sensor": accepted,
            "force_mode": mode("force_mode", True),
            "end_force_mode": mode("force_mode", False),
            "force_mode_set_damping": accepted,
            "force_mode_set_gain_scaling": accepted,
            "freedrive_mode": mode("freedrive", True),
            "end_freedrive_mode": mode("freedrive", False),
            "get_freedrive_status": lambda: 0,
            "teach_mode": mode("freedrive", True),
            "end_teach_mode": mode("freedrive", False),
            "tool_contact": lambda direction=None: robot.contact_cycles,
            "protective_stop": lambda: robot.protective_stop("the script asked for it"),
            "rtde_set_watchdog": self._set_watchdog,
            "textmsg": self._textmsg,
            "popup": self._popup,
        }

    def _sync(self) -> Wait:
        yield

    def _sleep(self, t: float) -> Wait:
        for _ in range(self._robot.cycles(t)):
            yield

    def _textmsg(self, s1: object, s2: object = "") -> None:
        text = text_of(s1) + text_of(s2)
        self._robot.journal.note("controller", "textmsg", text=text)
        self._robot.tell("text", text=text)

    def _popup(
        self,
        s: object,
        title: str = "Popup",
        warning: bool = False,
        error: bool = False,
        blocking: bool = False,
    ) -> Wait:
        robot = self._robot
        robot.popup = text_of(s)
        robot.journal.note("controller", "popup", text=robot.popup, title=title)
        robot.tell("popup", title=title, text=robot.popup, warning=warning, error=error)
        while blocking and robot.popup is not None:
            yield

    def _set_tcp(self, pose: Pose, tcp_name: str = "") -> None:
        self._robot.tcp = six(pose)

    def _set_payload(
        self, m: float, cog: Sequence[float] = (), inertia: Sequence[float] = (), transition_time: float = 0
    ) -> None:
        robot = self._robot
        robot.payload_kg = float(m)
        robot.payload_cog = tuple(map(float, cog)) or robot.payload_cog
        robot.payload_inertia = tuple(map(float, inertia)) or robot.payload_inertia

    def _set_watchdog(self, variable_name: str, min_frequency: float = 10.0, action: str = "pause") -> None:
        if variable_name not in self._robot.inputs.types or not 0 < min_frequency < inf:
            raise ScriptRuntimeError(f"no watchdog on {variable_name} at {min_frequency} Hz")
        action = action.lower()  # Universal Robots' own example writes it in capitals
        if action not in ("ignore", "pause", "stop"):
            raise ScriptRuntimeError(f"a watchdog's action is no {action}")
        self._robot.watchdog_s = 0.0 if action == "ignore" else 1.0 / min_frequency
        self._robot.watched, self._robot.watchdog_pauses = variable_name, action == "pause"
