"""Scripted scenarios: bounded by themselves, recorded from a controller, and compared figure by figure."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import msgspec
import pytest

from station.cell.errors import RefusedError
from station.cli import trace as command
from station.devices.ur_trace_scenarios import (
    SHIPPED,
    ScenarioRecorder,
    ScenarioTrace,
    TraceFile,
    compare,
    figures,
    read_traces,
    scenarios,
    write_traces,
)
from station.simulation.launch import start_controller
from tests.codes import raises
from tests.conftest import functions_called

RECORDED = ("rtde-input-claimed-twice", "unknown-question", "stopj-hard", "silence-in-motion")


@pytest.fixture(params=sorted(SHIPPED))
def shipped(request: pytest.FixtureRequest) -> TraceFile:
    return read_traces(SHIPPED[request.param])


def of(found: TraceFile, name: str) -> ScenarioTrace:
    return next(trace for trace in found.traces if trace.name == name)


def with_one(found: TraceFile, changed: ScenarioTrace) -> TraceFile:
    return msgspec.structs.replace(found, traces=(changed,))


def test_thirty_scenarios_of_which_each_that_moves_is_slow_and_turns_wrist_3_only() -> None:
    found = scenarios()
    assert len({s.name for s in found}) == len(found) >= 30
    for scenario in found:
        said = "\n".join([scenario.program, *(event.program for event in scenario.events)])
        assert scenario.moves or not re.search(r"\b(move|servo|speed|force|freedrive)", said), scenario.name
        for move in re.findall(r"move\w*\(.*\)", said):
            assert re.fullmatch(r"movej\((there|here), (a=0\.[0-8], v=0\.2|t=1\.0)\)", move), move


def test_all_of_them_are_shipped_for_both_generations(shipped: TraceFile) -> None:
    assert [trace.name for trace in shipped.traces] == [s.name for s in scenarios()]


def test_a_record_agrees_with_itself(shipped: TraceFile, tmp_path: Path) -> None:
    write_traces(tmp_path / "t.json.gz", shipped)
    assert read_traces(tmp_path / "t.json.gz") == shipped
    assert all(d.passed for d in compare(shipped, shipped))


@pytest.mark.parametrize(
    ("name", "late_s", "scale", "figure"),
    [
        ("movej", 0.1, 1.0, "starts at_s"),
        ("movej", 0.0, 1.2, "travel_rad"),
        ("stopj-hard", 0.0, 1.3, "peak_rad_s"),
    ],
)
def test_what_another_controller_does_otherwise_is_named(
    shipped: TraceFile, name: str, late_s: float, scale: float, figure: str
) -> None:
    trace = of(shipped, name)
    other = msgspec.structs.replace(
        trace,
        time_s=[t + late_s for t in trace.time_s],
        angle_rad=[scale * q for q in trace.angle_rad],
        speed_rad_s=[scale * v for v in trace.speed_rad_s],
    )
    assert figure in {d.figure for d in compare(shipped, with_one(shipped, other)) if not d.passed}


def test_a_later_reaction_another_state_and_another_word_are_named(shipped: TraceFile) -> None:
    trace = of(shipped, "dashboard-stop-in-motion")
    later = msgspec.structs.replace(trace, events_s=[at - 0.1 for at in trace.events_s])
    failed = {d.figure for d in compare(shipped, with_one(shipped, later)) if not d.passed}
    assert "reaction_s" in failed
    held = msgspec.structs.replace(trace, safety=[*trace.safety[:-1], 3])
    failed = {d.figure for d in compare(shipped, with_one(shipped, held)) if not d.passed}
    assert failed == {"safety modes"}
    words = msgspec.structs.replace(of(shipped, "mode"), answers={"robotmode": "Robotmode: IDLE"})
    assert "robotmode" in {d.figure for d in compare(shipped, with_one(shipped, words)) if not d.passed}


def test_what_is_no_record_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"no gzip", gzip.compress(b"{}")):
        (tmp_path / "t").write_bytes(content)
        with raises("no-traces"):
            read_traces(tmp_path / "t")


def test_a_scenario_moves_the_arm_by_movej_alone() -> None:
    every = list(scenarios())
    texts = [t for s in every for t in (s.program, s.stop, *(e.program for e in s.events)) if t]
    asked = {name for text in texts for name in functions_called(text)}
    assert asked <= {"mark", "movej", "stopj", "stopl", "sleep", "sync", "read_input_integer_register"}


@pytest.mark.process
def test_the_simulated_controller_does_what_is_shipped_of_it_and_nobody_is_asked_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with start_controller("UR10") as controller:
        monkeypatch.setattr(command, "_is_simulated", lambda host: False)
        with pytest.raises(RefusedError) as refused:
            command.trace_command("record", controller.host, output=tmp_path / "t.json.gz")
        assert refused.value.code == "no-person"
        with controller.admin() as admin:
            assert not [what for what in admin.ask("log")["counts"] if what.startswith("upload")]
        recorder = ScenarioRecorder(controller.host)
        traces = tuple(recorder.record(s) for s in scenarios() if s.name in RECORDED)
    assert len(traces) == len(RECORDED)
    found = compare(read_traces(SHIPPED[125]), TraceFile(recorder.controller, recorder.rate_hz, traces))
    assert len(found) > 10 and not [d for d in found if not d.passed]
    silent = figures(traces[-1])
    assert isinstance(silent["rest_s"], float) and silent["rest_s"] < 0.5, "the arm stops without us"
