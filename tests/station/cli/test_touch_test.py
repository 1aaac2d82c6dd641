"""`station touch-test` in a shell: each corner is read or left out, and the exit code says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from calibrate.boards.model import board_points
from calibrate.files.calibration import read_calibration
from station.cell.status import StationStatus
from station.cli import touch_test
from station.cli.app import STATION
from tests.codes import raises
from tests.station.operate.test_tip_offsets import Daemon


@pytest.fixture
async def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Daemon, Path]:
    """A daemon, a person's terminal, and the calibration that is tested."""
    daemon = Daemon()
    board = await daemon.seen(tmp_path)

    class Connected:
        root, camera = tmp_path, "main"

        async def __aenter__(self) -> Connected:
            return self

        async def __aexit__(self, *_: object) -> None: ...

        def __init__(self, _: Path) -> None: ...

    async def seen(*_: object) -> object:
        return board

    monkeypatch.setattr(touch_test, "Client", Connected)
    monkeypatch.setattr(touch_test, "see_board", seen)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    return daemon, tmp_path / "c.yaml"


@pytest.mark.parametrize(
    ("said", "touched", "code"), [(["", ""], 2, 0), (["s", ""], 1, 3), (["", "q"], 1, 3), (["q"], 0, 1)]
)
def test_each_corner_is_read_or_left_out(
    said: list[str],
    touched: int,
    code: int,
    cell: tuple[Daemon, Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    daemon, path = cell
    answers, places = iter(said), [0, 6]

    def prompt(question: str, **_: Any) -> str:
        answer = next(answers)
        daemon.at = places.pop(0)  # type: ignore[attr-defined]
        return answer

    async def now(_: object) -> StationStatus:
        return daemon.touching(board_points(daemon.truth.board)[daemon.at])  # type: ignore[attr-defined]

    monkeypatch.setattr("typer.prompt", prompt)
    monkeypatch.setattr(touch_test, "status_now", now)
    with pytest.raises(SystemExit) as end:
        STATION(["touch-test", str(path), "--corner", "0", "--corner", "6"], prog_name="station")
    assert end.value.code == code
    assert [touch.corner for touch in read_calibration(path).verification] == (
        [0, 6] if touched == 2 else [6] if said[0] == "s" else [0][:touched]
    )


def test_without_a_person_it_is_refused(cell: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    with raises("no-person"):
        STATION(["touch-test"], prog_name="station")
