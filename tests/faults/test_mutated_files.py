"""A share of the mutated files; the whole run is `python -m tests.faults.mutated_files`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.mutated_files import TARGETS, Target, batch

CASES = 12
SEED = 20


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_whatever_is_in_a_file_nobody_gets_a_traceback(target: Target, tmp_path: Path) -> None:
    outcomes, _ = batch(target, list(range(CASES)), SEED, tmp_path / "case", by_call=False)
    assert len(outcomes) == CASES
    assert not [outcome for outcome in outcomes if outcome.end in ("traceback", "death")]


@pytest.mark.parametrize("target", TARGETS[:: len(TARGETS) // 6], ids=lambda target: target.name)
def test_nor_does_a_program_that_calls(target: Target, tmp_path: Path) -> None:
    outcomes, _ = batch(target, [0, 1], SEED, tmp_path / "case", by_call=True)
    assert not [outcome for outcome in outcomes if outcome.end in ("traceback", "death")]
