"""The public doors: the example runs, its names exist."""

from __future__ import annotations

import inspect
import textwrap
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import recordings
from tests.recordings.small_recording import make_state, write_small


def test_the_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_small(tmp_path / "session.mcap")
    monkeypatch.chdir(tmp_path)
    lines = (recordings.__doc__ or "").splitlines()[1:]
    names: dict[str, object] = {}
    exec(textwrap.dedent("\n".join(line for line in lines if line.startswith("    ") or not line)), names)
    told = [list(make_state(count).joints_rad) for count in range(9)]
    assert names["robot"].joints_rad.tolist() == told
    assert np.shape(names["joints_rad"]) == (6, 3)
    assert len(capsys.readouterr().out.splitlines()) == 3


@pytest.mark.parametrize("room", ["recordings", "calibrate", "calibrate.handeye"])
def test_every_name_of_a_door_exists_and_says_what_it_is(room: str) -> None:
    door = import_module(room)
    for name in door.__all__:
        assert inspect.getdoc(getattr(door, name)), name
    with pytest.raises(AttributeError):
        door.nothing  # noqa: B018
