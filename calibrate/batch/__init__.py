"""Many recordings, solved in a process pool or on a cluster, and their trends."""

from __future__ import annotations

import msgspec


class BatchResult(msgspec.Struct, frozen=True, omit_defaults=True):
    recording: str
    key: str
    """Key of recording and options: a finished one is not solved again."""
    solved: bool
    passed: bool = False
    error: str = ""
    session: str = ""
    robot: str = ""
    camera: str = ""
    recorded_wall_ns: int = 0
    mount: str = ""
    translation_m: tuple[float, ...] = ()
    rotation_xyzw: tuple[float, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    sigma_mm: float | None = None
    sigma_deg: float | None = None
    e_t_mm: float | None = None
    rms_px: float | None = None
    views: int = 0
    rejected: int = 0
    failed_gates: tuple[str, ...] = ()
    calibration: str = ""
    """File name in the output folder."""
    content_sha256: str = ""
    """Hash of the calibration: equal for equal results, whoever computed them."""
