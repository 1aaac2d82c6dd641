"""Fixtures every room shares. Real recordings by other people are used where they lie beside the checkout."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATASETS = Path(os.environ.get("STATION_DATASETS", Path(__file__).parents[2] / "shared" / "datasets"))


@pytest.fixture
def datasets() -> Path:
    """Folder of real recordings; the test is skipped, with the reason, where it is absent."""
    if not DATASETS.is_dir():
        pytest.skip(f"no real recordings at {DATASETS} (set STATION_DATASETS)")
    return DATASETS
