"""Control of an arm by the station's own script, where ur_rtde is not available.

The script is uploaded once. Every RTDE data packet carries everything: sequence, verb, keepalive, six joints,
speed, acceleration. A verb is carried out once, when its sequence is new; the script answers with that
sequence, negative if it refuses. Once armed, the script ends when the keepalive does not change for 0.2 s: it
kills the thread that moves, brakes and halts, as Universal Robots' own library does. It ends the same way for
any other reason. One that nobody arms ends 20 s after the last keepalive or command. A lost connection is
never reopened, and the script ends with it.
"""

from __future__ import annotations

import math
import random
import select
import socket
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import NamedTuple

from station.cell.errors import RobotError
from station.devices.rtde import HANDSHAKE_S, PORT, PacketType, RtdeError, RtdeLink, RuntimeState
from station.devices.ur.moves import JOINT_ACCELERATION_LIMIT_RAD_S2, JOINT_SPEED_LIMIT_RAD_S, STOP_RAD_S2

SCRIPT_PORT = 30002
FIRST_REGISTER = 24
"""First register used: the upper half is for RTDE clients, the lower for field buses."""
SILENCE_S = 0.2
"""Time without a new keepalive after which the script stops the arm and ends."""
UNARMED_S = 20.0
"""The same before the watchdog is armed: whoever started the script has died."""
RATE_HZ = 125.0
START_S = 5.0
SETTLE_SAMPLES = 5
"""Samples to wait until the first packet is in the registers: the script refuses old contents."""
ANSWER_S = 0.25
STOP_ANSWER_S = 0.04
END_S = 0.5
STALE_S = 0.5
"""Time without news after which the script counts as lost. The session gives up earlier."""


class Command(IntEnum):
    """Commands to the script; any other number ends it."""

    NONE = 0
    ARM = 1
    MOVE = 2
    STOP = 3
    END = 4


class State(IntEnum):
    """State as the script reports it."""

    WAITING = 1
    ARMED = 2
    MOVING = 3
    ENDED = 4


SCRIPT = """\
def station_control():
  # Inputs from {r}: integers sequence, verb, keepalive; floats six joints, speed, acceleration.
  # Outputs from {r}: integers answer, state; floats TCP offset. Integer 2: count of moves, and running.
  global goal = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  global speed = 0.0
  global acceleration = 0.0
  global moving = False
  thread motion():
    movej(goal, a=acceleration, v=speed)
    moving = False
  end
  def read_move():
    local i = 0
    while i < 6:
      goal[i] = read_input_float_register({r} + i)
      if not (norm(goal[i]) <= {joint_limit}):
        return False
      end
      i = i + 1
    end
    speed = read_input_float_register({r} + 6)
    acceleration = read_input_float_register({r} + 7)
    if speed > {speed_limit}:
      speed = {speed_limit}
    end
    if acceleration > {acceleration_limit}:
      acceleration = {acceleration_limit}
    end
    return (speed > 0) and (acceleration > 0)
  end
  seen = {sequence}
  if read_input_integer_register({r}) != seen:
    halt
  end
  tcp = get_tcp_offset()
  n = 0
  while n < 6:
    write_output_float_register({r} + n, tcp[n])
    n = n + 1
  end
  hand = 0
  moves = 0
  armed = False
  silence = 0.0
  kept = read_input_integer_register({r} + 2)
  write_output_integer_register(2, 0)
  write_output_integer_register({r} + 1, {waiting})
  write_output_integer_register({r}, seen)
  obeying = True
  while obeying:
    sync()
    sequence = read_input_integer_register({r})
    verb = read_input_integer_register({r} + 1)
    alive = read_input_integer_register({r} + 2)
    if (alive != kept) or ((not armed) and (sequence != seen)):
      kept = alive
      silence = 0.0
    else:
      silence = silence + get_steptime()
    end
    if (silence > {unarmed}) or (armed and (silence > {silence})):
      obeying = False
    elif sequence != seen:
      seen = sequence
      answer = 0 - sequence
      if verb == {arm}:
        armed = True
        answer = sequence
      elif verb == {move}:
        if armed and not moving:
          if read_move() and (read_input_integer_register({r}) == sequence):
            moves = moves + 1
            if moves > 127:
              moves = 1
            end
            moving = True
            hand = run motion()
            answer = sequence
          end
        end
      else:
        answer = sequence
        obeying = False
      end
      write_output_integer_register({r}, answer)
    end
    if moving:
      write_output_integer_register(2, moves * 16777216 + 32768)
      write_output_integer_register({r} + 1, {moving})
    else:
      write_output_integer_register(2, moves * 16777216)
      if armed:
        write_output_integer_register({r} + 1, {armed})
      end
    end
  end
  write_output_integer_register({r} + 1, {ended})
  if moving:
    kill hand
    stopj({stop})
  end
  write_output_integer_register(2, moves * 16777216)
  halt
end
"""


def script(sequence: int) -> str:
    """Make the program; it starts only if its sequence register holds this value."""
    return SCRIPT.format(
        r=FIRST_REGISTER, sequence=sequence, joint_limit=2 * math.pi, speed_limit=JOINT_SPEED_LIMIT_RAD_S,
        acceleration_limit=JOINT_ACCELERATION_LIMIT_RAD_S2, silence=SILENCE_S, unarmed=UNARMED_S,
        stop=STOP_RAD_S2, arm=int(Command.ARM), move=int(Command.MOVE), waiting=int(State.WAITING),
        armed=int(State.ARMED), moving=int(State.MOVING), ended=int(State.ENDED),
    )  # fmt: skip


_INPUTS = (
    *(f"input_int_register_{FIRST_REGISTER + i}" for i in range(3)),
    *(f"input_double_register_{FIRST_REGISTER + i}" for i in range(8)),
)
_OUTPUTS = (
    "timestamp",
    "runtime_state",
    *(f"output_int_register_{FIRST_REGISTER + i}" for i in range(2)),
    *(f"output_double_register_{FIRST_REGISTER + i}" for i in range(6)),
)


class Told(NamedTuple):
    """Sample of the states of controller and script."""

    controller_s: float
    program: int
    """RuntimeState"""
    answer: int
    state: int
    tcp: tuple[float, ...]


class ScriptControl:
    """Control by the script, with the names and meanings of ur_rtde's calls. For one thread."""

    def __init__(self, host: str) -> None:
        """Upload the script and wait until it answers.

        Raises RobotError `registers-in-use`, `no-state`, `program-playing`, `script-not-started`; OSError.
        """
        self._told = Told(-1.0, RuntimeState.STOPPED, 0, 0, ())
        self._told_s = time.monotonic()
        """When the controller's clock last advanced (host monotonic)."""
        self._samples = 0
        self._lost = self._broken = False
        self._keepalive = 0
        self._command: tuple[int, Command, Sequence[float]] = (0, Command.NONE, (0.0,) * 8)
        self._link = socket.create_connection((host, PORT), HANDSHAKE_S)
        try:
            self._start(host)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the connection; the script then ends by itself."""
        self._lost = self._broken = True
        self._link.close()

    def _start(self, host: str) -> None:
        self._rtde = RtdeLink(self._link)
        self._inputs = self._rtde.inputs(_INPUTS)
        self._outputs = self._rtde.outputs(RATE_HZ, _OUTPUTS)
        self._rtde.start()
        for kind, payload in self._rtde.pending:
            self._take(kind, payload)
        self._link.setblocking(False)
        sequence = random.randrange(1, 2**30)  # so that an earlier script's answer is not taken for ours
        self._write(sequence, Command.NONE)
        if not self._wait(lambda: self._samples > SETTLE_SAMPLES, HANDSHAKE_S):
            raise RtdeError("no-state", host=host, limit_s=HANDSHAKE_S)
        if self._told.program not in (RuntimeState.STOPPED, RuntimeState.STOPPING):
            raise RobotError("program-playing")
        with socket.create_connection((host, SCRIPT_PORT), HANDSHAKE_S) as upload:
            upload.sendall(script(sequence).encode("ascii"))
            # Keep it open until the script answers: closing with unread data could discard the text.
            if not self._wait(lambda: self._plays() and self._told.answer == sequence, START_S):
                raise RobotError("script-not-started")

    # -- the six calls ----------------------------------------------------------------------------------

    def getTCPOffset(self) -> list[float]:
        """Return flange_from_tcp, read by the script at its start: metres, rotation vector (rad)."""
        return list(self._told.tcp)

    def setWatchdog(self, minimum_hz: float) -> bool:
        """Arm the watchdog: the script then ends after `SILENCE_S` (not `minimum_hz`) without keepalive."""
        return self._ask(Command.ARM)

    def kickWatchdog(self) -> bool:
        """Send the next keepalive; False, without sending, when the script is lost."""
        if not self._alive():
            return False
        self._keepalive = self._keepalive % (2**31 - 1) + 1
        self._write(*self._command)
        return not self._lost

    def moveJ(self, q: Sequence[float], speed: float, acceleration: float, asynchronous: bool) -> bool:
        """Start a move; True when the script accepted it. Speeds above the script's limits are lowered."""
        return self._ask(Command.MOVE, (*q, speed, acceleration))

    def stopJ(self, deceleration: float, asynchronous: bool) -> None:
        """Stop: the script brakes with its own deceleration, then ends. Waits briefly for its answer."""
        sequence = self._write(self._command[0] + 1, Command.STOP)
        self._wait(lambda: self._told.answer == sequence or not self._plays(), STOP_ANSWER_S)

    def stopScript(self) -> None:
        self._write(self._command[0] + 1, Command.END)
        self._wait(lambda: not self._plays(), END_S)

    # -- the connection ---------------------------------------------------------------------------------

    def _ask(self, verb: Command, numbers: Sequence[float] = (0.0,) * 8) -> bool:
        """Send a command and wait for the answer; without one the script counts as lost."""
        if not self._alive():
            return False
        sequence = self._write(self._command[0] + 1, verb, numbers)
        if not self._wait(lambda: abs(self._told.answer) == sequence or not self._alive(), ANSWER_S):
            self._lose()
        return self._told.answer == sequence and not self._lost

    def _plays(self) -> bool:
        return not self._lost and self._told.program == RuntimeState.PLAYING

    def _alive(self) -> bool:
        """Tell by current news whether the script plays and obeys; once lost it stays lost."""
        self._read()
        if time.monotonic() - self._told_s > STALE_S or self._told.state == State.ENDED or not self._plays():
            self._lose()
        return not self._lost

    def _lose(self) -> None:
        """Mark the script as lost, and leave STOP in the registers for a paused one that is resumed."""
        if not self._lost:
            self._lost = True
            self._write(self._command[0] + 1, Command.STOP)

    def _write(self, sequence: int, verb: Command, numbers: Sequence[float] = (0.0,) * 8) -> int:
        """Send one packet; a connection that does not take it at once is closed. Returns the sequence."""
        self._command = (sequence, verb, numbers)
        try:
            if not self._broken:
                self._link.sendall(self._inputs.pack((sequence, verb, self._keepalive, *numbers)))
        except OSError:
            self.close()  # after half a packet the next one would be read as its rest
        return sequence

    def _wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Read until `condition` holds; False at the deadline, or when the connection is lost."""
        give_up_s = time.monotonic() + timeout_s
        while not condition():
            left_s = give_up_s - time.monotonic()
            if left_s <= 0 or self._broken:
                return False
            select.select([self._link], [], [], left_s)
            self._read()
        return True

    def _read(self) -> None:
        """Read and handle everything that has arrived."""
        try:
            while not self._broken:
                data = self._link.recv(65536)
                if not data:
                    self.close()
                for kind, payload in self._rtde.packets.feed(data):
                    self._take(kind, payload)
        except BlockingIOError:
            pass
        except (OSError, RtdeError):
            self.close()

    def _take(self, kind: int, payload: bytes) -> None:
        if kind != PacketType.DATA:
            return
        v = self._outputs.unpack_elements(payload)
        if v[0] != self._told.controller_s:
            self._told_s = time.monotonic()
            self._samples += 1
        self._told = Told(v[0], int(v[1]), int(v[2]), int(v[3]), v[4:10])
