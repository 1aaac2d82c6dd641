"""`station demo`: what is said when one of its steps fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from station.demo import DemoError, _solve


async def test_a_solve_that_failed_says_why_under_one_name(tmp_path: Path) -> None:
    with pytest.raises(DemoError) as failed:
        await _solve(tmp_path / "none.mcap", tmp_path / "calibration.yaml", tmp_path / "report.html")
    assert str(failed.value).startswith(f"cannot open {tmp_path}")
