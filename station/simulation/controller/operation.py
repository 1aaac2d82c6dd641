"""Asynchronous operations of the script: a thread that moves, and the word that reports its progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from station.simulation.controller.arm import Arm, MakePath, Motion


class AsyncWord:
    """bits 24–30 operation id, 16–22 change counter, 15 running, 0–14 progress."""

    def __init__(self, write: Callable[[int], None]) -> None:
        self._write = write
        self._operation = 0
        self._change = 0

    def start(self) -> None:
        self._operation = (self._operation + 1) & 0x7F
        self.progress(0)

    def progress(self, value: int) -> None:
        self._put(True, value & 0x7FFF)

    def finish(self) -> None:
        self._put(False, 0)

    def _put(self, running: bool, progress: int) -> None:
        self._change = (self._change + 1) & 0x7F
        self._write(self._operation << 24 | self._change << 16 | running << 15 | progress)


@dataclass(frozen=True)
class MoveStep:
    make_path: MakePath
    speed: float
    acceleration: float


class Operation:
    """Moves and progress marks, one after the other. With a word it reports itself there, from the cycle
    after it was asked for; the arm begins at once."""

    def __init__(self, arm: Arm, steps: list[MoveStep | int], word: AsyncWord | None) -> None:
        self._arm = arm
        self._steps = list(steps)
        self._word = word
        self._motion: Motion | None = None
        self._started = word is None
        if self._steps and isinstance(self._steps[0], MoveStep):
            self._begin_move()

    def _begin_move(self) -> None:
        step = self._steps.pop(0)
        assert isinstance(step, MoveStep)
        self._motion = self._arm.start(step.make_path, step.speed, step.acceleration)

    def kill(self) -> None:
        """Another move or a stop takes over."""
        if self._word is not None:
            if not self._started:
                self._word.start()
            self._word.finish()

    def step(self) -> bool:
        """One cycle; True when everything is done. Raises UnreachableError."""
        if not self._started:
            self._started = True
            assert self._word is not None
            self._word.start()
            return False
        while True:
            if self._motion is not None and not self._motion.done:
                return False
            self._motion = None
            if self._arm.moving:
                return False
            if not self._steps:
                break
            if isinstance(self._steps[0], MoveStep):
                self._begin_move()
                continue
            mark = self._steps.pop(0)
            if self._word is not None and isinstance(mark, int):
                self._word.progress(mark)
        if self._word is not None:
            self._word.finish()
        return True
