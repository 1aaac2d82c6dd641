"""The controller behind the sockets: arm, power, safety, program, registers; one `tick` per cycle.

Knows no socket, so that every rule here can be tested without one.
"""

from __future__ import annotations

from station.devices.rtde import RobotMode, RuntimeState, SafetyMode
from station.simulation.controller.arm import PROGRAM_END_RAD_S2, JointMotion, UnreachableError
from station.simulation.controller.interpreted import InterpretedProgram
from station.simulation.controller.kinematics import Rigid, Vector, forward, nudged
from station.simulation.controller.state import ControllerState, Journal, Settings
from station.simulation.controller.uploads import Upload
from station.simulation.controller.urscript_parser import ScriptError, ScriptSyntaxError

PROGRAM_START_S = 0.05
WAITS = "while True:\n  sync()\nend"
"""A program that only occupies the arm."""


class SimulatedRobot(ControllerState):
    def __init__(self, settings: Settings, journal: Journal) -> None:
        super().__init__(settings, journal)
        self.program: InterpretedProgram | None = None
        self._starting: tuple[int, InterpretedProgram] | None = None
        self._silence_s = 0.0
        self._hands: JointMotion | None = None

    def tick(self, monotonic_ns: int, late: bool = False) -> None:
        """One cycle; `monotonic_ns` is when it is due. `late`: many cycles run at once because this
        process was held up; such time does not count as the client's silence."""
        self.ticks += 1
        self.time_s = self.ticks * self.dt_s
        if self._starting is not None:
            self._count_down()
        if self.program is not None and self.runtime_state == RuntimeState.PLAYING:
            self._step_program(late)
        held = self.robot_mode != RobotMode.RUNNING or not self.safe
        by_hand = self._hands is not None and not self._hands.done
        held |= self.runtime_state == RuntimeState.PAUSED and not by_hand
        scale = 0.0 if held else 1.0 if by_hand else self.slider
        self.arm.step(self.dt_s * self.settings.time_scale, scale)
        self.history.add(monotonic_ns, self.arm.actual, self.arm.miss)
        self.publish()

    def _count_down(self) -> None:
        assert self._starting is not None
        left, program = self._starting
        if left > 0:
            self._starting = (left - 1, program)
            return
        self._starting = None
        self.program = program
        self.runtime_state = RuntimeState.PLAYING
        self.tell(program.name)

    def _step_program(self, late: bool) -> None:
        assert self.program is not None
        if self.watchdog_s > 0 and not late:
            self._silence_s += self.dt_s
            if self._silence_s > self.watchdog_s:
                self.stop_program(f"watchdog: {self.watched} was silent")
                return
        try:
            if not late and not self.program.step():
                self.stop_program("the program ended")
        except (ScriptError, UnreachableError) as error:
            self.journal.note("controller", "runtime error", name=self.program.name, error=str(error))
            self.stop_program(f"runtime error: {error}")

    def receive_inputs(self, names: tuple[str, ...], elements: tuple[float, ...]) -> None:
        """A data packet: it acts in the next cycle."""
        self.inputs.write(names, elements)
        for name in names:
            if name in self.outputs.types:  # input registers can be read back
                self.outputs.set(name, *self.inputs.vector(name))
        if self.watched in names:
            self._silence_s = 0.0

    @property
    def safe(self) -> bool:
        return self.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)

    @property
    def accepts_programs(self) -> bool:
        local = self.settings.is_e_series and not self.remote
        return self.safe and self.robot_mode == RobotMode.RUNNING and not local

    @property
    def free_for_hands(self) -> bool:
        """The pendant's arrows or free-drive may move the arm."""
        playing = self.runtime_state == RuntimeState.PLAYING
        return self.safe and self.robot_mode == RobotMode.RUNNING and not playing

    def lead(self, joints_rad: Vector, speed_rad_s: float, acceleration_rad_s2: float) -> bool:
        """A person moves the arm; a paused program's motion is lost. False while it is not free."""
        if not self.free_for_hands:
            return False
        if self.arm.moving:
            self.arm.freeze()
        self._hands = self.arm.start(joints_rad, speed_rad_s, acceleration_rad_s2)
        return True

    def upload(self, upload: Upload) -> None:
        """A program arrived on a script port: it replaces whatever runs, or is silently ignored."""
        accepted = self.accepts_programs
        self.journal.note(
            "upload", upload.name or upload.text[:200], characters=len(upload.text), accepted=accepted
        )
        if accepted:
            self._start_upload(upload)

    def _start_upload(self, upload: Upload) -> None:
        """Where it cannot start, its clients are told why."""
        name = upload.name or "line"
        try:
            program = InterpretedProgram(self, name, upload.text)
        except ScriptSyntaxError as error:
            self.journal.note("controller", "syntax error", name=name, error=str(error))
            self.stop_program("replaced by a program that cannot start")
        else:
            self.start_program(program)

    def start_program(self, program: InterpretedProgram) -> None:
        self.stop_program(f"replaced by {program.name}")
        self._starting = (round(PROGRAM_START_S / self.settings.time_scale / self.dt_s), program)

    def stop_program(self, reason: str) -> None:
        """Ends the program (if any); a motion decelerates. Registers keep their values."""
        if self.program is not None or self._starting is not None:
            name = self.program.name if self.program is not None else "program"
            self.journal.note("controller", "program stopped", name=name, reason=reason)
        if self.program is not None:
            self.program.end()
        self.program = self._starting = None
        self.runtime_state = RuntimeState.STOPPED
        self.watchdog_s = self._silence_s = 0.0
        self.arm.brake(PROGRAM_END_RAD_S2)

    def pause_program(self) -> bool:
        if self.runtime_state != RuntimeState.PLAYING:
            return False
        self.runtime_state = RuntimeState.PAUSED
        return True

    def play_program(self) -> bool:
        """Resumes a paused program."""
        ready = self.safe and self.robot_mode == RobotMode.RUNNING
        if not ready or self.program is None or self.runtime_state != RuntimeState.PAUSED:
            return False
        self.runtime_state = RuntimeState.PLAYING
        self._silence_s = 0.0
        return True

    def protective_stop(self, reason: str) -> None:
        """The arm rests at once, until the controller is started again."""
        self.journal.note("controller", "protective stop", reason=reason)
        self.safety_mode = SafetyMode.PROTECTIVE_STOP
        self.arm.freeze()
        if self.program is None:
            self.stop_program("protective stop")
        else:
            self.runtime_state = RuntimeState.PAUSED

    def safeguard(self) -> None:
        self.safety_mode = SafetyMode.SAFEGUARD_STOP
        self.pause_program()

    def emergency_stop(self) -> None:
        self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP
        self.power_off(RobotMode.IDLE if self.settings.is_e_series else RobotMode.POWER_OFF)

    def power_off(self, mode: RobotMode = RobotMode.POWER_OFF) -> None:
        self.stop_program("power off")
        self.arm.freeze()
        self.robot_mode = mode

    def reset(self, running: bool) -> None:
        """After a reboot."""
        self.clear()
        self.safety_mode = SafetyMode.NORMAL
        self.robot_mode = RobotMode.RUNNING if running else RobotMode.POWER_OFF

    def true_flange(self, joints: Vector, miss: Vector) -> Rigid:
        """base_from_flange with the arm's real lengths and its repeatability error."""
        return nudged(forward(self.true_table, joints), miss)
