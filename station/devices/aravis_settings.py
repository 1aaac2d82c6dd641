"""What is set on a GenICam camera, and whether it still stands so: another program may change it at any time.

`camera` and `aravis`: an opened `Aravis.Camera` and its library, both from `aravis_device`.
"""

from __future__ import annotations

from typing import Any

from station.cell.config import CameraConfig
from station.cell.errors import CameraError

Region = tuple[int, int, int, int]
"""x, y, width, height, pixels"""
_EXPOSURE_TOLERANCE = 0.02
_GAIN_TOLERANCE_DB = 0.2


def apply_settings(aravis: Any, camera: Any, config: CameraConfig) -> Region:
    """Everything the configuration says, automatics off; the region that was set."""
    camera.set_range_check_policy(aravis.RangeCheckPolicy.ENABLE)
    camera.stop_acquisition()
    camera.clear_triggers()
    for automatic in ("ExposureAuto", "GainAuto"):
        if camera.is_feature_available(automatic):
            camera.set_string(automatic, "Off")
    camera.set_pixel_format_from_string(config.pixel_format)
    # Cameras keep the region of whoever used them last.
    region: Region = config.region or (0, 0, *camera.get_sensor_size())
    camera.set_region(*region)
    camera.set_exposure_time(config.exposure_us)
    if camera.is_gain_available():
        camera.set_gain(config.gain_db)
    if camera.is_gv_device():
        if config.packet_size is None:
            camera.gv_auto_packet_size()
        else:
            camera.gv_set_packet_size(config.packet_size)
    camera.set_acquisition_mode(aravis.AcquisitionMode.CONTINUOUS)
    if config.trigger == "free-running":
        if config.frame_rate_hz is not None:
            camera.set_frame_rate(config.frame_rate_hz)
    else:
        camera.set_trigger("Software" if config.trigger == "software" else "Line0")
    return region


def read_settings(camera: Any) -> dict[str, Any]:
    """As the camera tells them now; JSON types only."""
    x, y, width, height = _region(camera)
    return {
        "pixel_format": camera.get_pixel_format_as_string(),
        "region": [x, y, width, height],
        "exposure_us": camera.get_exposure_time(),
        "gain_db": camera.get_gain() if camera.is_gain_available() else 0.0,
        "packet_size": camera.gv_get_packet_size() if camera.is_gv_device() else None,
    }


def require_settings(camera: Any, wanted: CameraConfig, region: Region) -> tuple[float, float]:
    """Exposure (µs) and gain (dB) as they are; CameraError when they are not what was asked for."""
    exposure_us = float(camera.get_exposure_time())
    gain_db = float(camera.get_gain()) if camera.is_gain_available() else 0.0
    actual = _region(camera)
    if (
        abs(exposure_us - wanted.exposure_us) > _EXPOSURE_TOLERANCE * wanted.exposure_us
        or abs(gain_db - wanted.gain_db) > _GAIN_TOLERANCE_DB
        or actual != region
    ):
        raise CameraError(
            f"the camera stands at {exposure_us:g} µs, {gain_db:g} dB, region {actual}; set were "
            f"{wanted.exposure_us:g} µs, {wanted.gain_db:g} dB, region {region}: the "
            "camera cannot do that, or another program changes its settings"
        )
    return exposure_us, gain_db


def _region(camera: Any) -> Region:
    found = camera.get_region()
    return found.x, found.y, found.width, found.height
