"""Looking for `station watch` on the real daemon: the arm is not asked to move."""

from __future__ import annotations

import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.geometry import inverse
from calibrate.projection import project_at
from station.cell.status import StationState as S
from station.protocol.verbs import Observe
from tests.conftest import asked
from tests.system.conftest import TRUTH, SystemRig, status_when

pytestmark = pytest.mark.process


async def test_the_corners_belong_to_the_pose_that_is_told_with_them(rig: SystemRig) -> None:
    daemon = await rig.daemon()
    async with await daemon.client() as client:
        await status_when(client, lambda s: s.state is S.IDLE and s.camera.connected)
        await status_when(client, lambda s: s.robot.still)
        seen = await client.call(Observe(TRUTH.board))
        mount, place = np.array(TRUTH.camera_mount), np.array(TRUTH.board_place)
        camera_from_board = inverse(np.array(seen.base_from_flange) @ mount) @ place
        expected = project_at(TRUTH.camera, camera_from_board, board_points(TRUTH.board)[list(seen.corners)])
        assert len(seen.corners) == len(board_points(TRUTH.board))
        assert np.abs(np.array(seen.pixels) - expected).max() < 1.0  # the arm misses by 0.05 mm
    assert asked(rig.admin, "upload") == asked(rig.admin, "move") == 0
