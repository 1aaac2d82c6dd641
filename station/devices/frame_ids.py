"""Frame numbers of the transports, and the frames between two of them."""

from __future__ import annotations

from enum import StrEnum

LAST_BLOCK_ID = 65_535


class FrameIds(StrEnum):
    BLOCK = "block"
    """GigE Vision: 16 bits, 1 … 65535 and 1 again; 0 means no number."""
    WIDE = "wide"
    """USB3 Vision, extended ids of GigE Vision 2, others: to the end of 8 … 64 bits, then 0 again."""


def frames_between(earlier_id: int, later_id: int, ids: FrameIds = FrameIds.BLOCK) -> int | None:
    """Number of frames from one id to a later one: 1 for the next, 0 for the same.

    None: the camera began to number anew, which tells nothing about frames between.
    """
    if ids is FrameIds.BLOCK and max(earlier_id, later_id) <= LAST_BLOCK_ID:
        return (later_id - earlier_id) % LAST_BLOCK_ID
    if later_id >= earlier_id:
        return later_id - earlier_id
    width = next(size for size in (1 << 8, 1 << 16, 1 << 32, 1 << 64) if size > earlier_id)
    steps = (later_id - earlier_id) % width
    return steps if steps < width // 2 else None
