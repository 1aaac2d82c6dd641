"""Robot pose and picture belong to the same moment, also while the arm moves."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.time_sync import measure

pytestmark = pytest.mark.process


async def test_the_pose_at_mid_exposure_is_right_while_the_arm_moves() -> None:
    sync = await measure(pictures=12, moving=True, settle_s=2.0)
    assert np.max(sync.speed_mm_s) > 50, "it did move"
    assert np.mean(np.abs(sync.time_error_ms) <= sync.bound_ms) >= 0.93
    # What a wrong time by its bound would do at this speed, and the robot's own clock's share of 1 ms.
    allowed_mm = sync.speed_mm_s * (sync.bound_ms + 1.0) / 1000 + 0.02
    assert np.mean(sync.position_error_mm <= allowed_mm) >= 0.9
