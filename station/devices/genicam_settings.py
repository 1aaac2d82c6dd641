"""Settings of a GenICam camera: applying, reading back and checking them. Imports no Aravis itself."""

from __future__ import annotations

from typing import Any, NamedTuple

from station.cell.config import CameraConfig
from station.cell.errors import CameraError

Region = tuple[int, int, int, int]
"""x, y, width, height, pixels"""
_EXPOSURE_TOLERANCE = 0.02
_GAIN_TOLERANCE = 0.2
"""Largest accepted difference between set and read gain, dB or the camera's unit"""


class Applied(NamedTuple):
    """Settings that were applied to the camera."""

    region: Region
    gain: float
    """In the camera's unit"""
    gain_in_db: bool


def apply_settings(aravis: Any, camera: Any, config: CameraConfig) -> Applied:
    """Apply the configuration, automatic functions off. CameraError for what the camera cannot do."""
    camera.set_range_check_policy(aravis.RangeCheckPolicy.ENABLE)
    camera.stop_acquisition()
    camera.clear_triggers()
    # Cameras keep what the last program set.
    for name, value in (("ExposureAuto", "Off"), ("GainAuto", "Off"), ("ExposureMode", "Timed")):
        if camera.is_feature_available(name) and camera.get_string(name) != value:
            camera.set_string(name, value)
    for name in ("ReverseX", "ReverseY"):  # no lens fits a mirrored image, nor does a board
        if camera.is_feature_available(name) and camera.get_boolean(name):
            camera.set_boolean(name, False)
    camera.set_pixel_format_from_string(config.pixel_format)
    region: Region = config.region or (0, 0, *camera.get_sensor_size())
    camera.set_region(*region)
    camera.set_exposure_time(config.exposure_us)
    gain = _wanted_gain(camera, config)
    if camera.is_gain_available():
        camera.set_gain(gain)
    if camera.is_gv_device():
        if config.packet_size is None:
            camera.gv_auto_packet_size()
        else:
            camera.gv_set_packet_size(config.packet_size)
        if camera.is_feature_available("GevSCPD"):
            camera.gv_set_packet_delay(0)  # raised after each frame that lost packets
    if camera.are_chunks_available():
        camera.set_chunk_mode(False)
    camera.set_acquisition_mode(aravis.AcquisitionMode.CONTINUOUS)
    _set_trigger(camera, config)
    return Applied(region, gain, _knows_db(camera))


def _set_trigger(camera: Any, config: CameraConfig) -> None:
    """Set one frame per trigger, without delay, at the rising edge, as cameras keep earlier settings."""
    hardware = config.trigger == "hardware"
    camera.set_trigger(config.trigger_line if hardware else "Software")
    for name in ("TriggerDelay", "TriggerDelayAbs"):
        if camera.is_feature_available(name):
            camera.set_float(name, 0.0)
    if not hardware:
        return
    if camera.is_feature_available("TriggerActivation"):
        camera.set_string("TriggerActivation", "RisingEdge")
    if camera.is_feature_available("LineSelector"):
        camera.set_string("LineSelector", config.trigger_line)
        if camera.is_feature_available("LineMode") and camera.get_string("LineMode") != "Input":
            camera.set_string("LineMode", "Input")
        if camera.is_feature_available("LineInverter"):
            camera.set_boolean("LineInverter", False)


def gain_unit(camera: Any) -> str:
    """Read the camera's unit of gain, such as dB; empty: not stated."""
    for name in ("Gain", "GainRaw", "GainAbs"):
        if camera.is_feature_available(name):
            node = camera.get_device().get_feature(name)
            return str(node.get_unit() or "") if hasattr(node, "get_unit") else ""
    return ""


def _knows_db(camera: Any) -> bool:
    return gain_unit(camera).strip().lower() == "db"


def _wanted_gain(camera: Any, config: CameraConfig) -> float:
    """Return the configured gain in the camera's unit; without dB, 0 dB is the camera's smallest gain.

    CameraError where another than 0 dB is configured and cannot be set.
    """
    if not camera.is_gain_available():
        if config.gain_db:
            raise CameraError("no-gain")
        return 0.0
    if _knows_db(camera):
        return config.gain_db
    low, high = camera.get_gain_bounds()
    if config.gain_db:
        unit = gain_unit(camera) or "a unit of its own"
        raise CameraError("gain-unit", unit=unit, low=low, high=high)
    return float(low)


def read_settings(camera: Any) -> dict[str, object]:
    """Read the settings back; JSON types only."""
    x, y, width, height = _region(camera)
    gain = camera.get_gain() if camera.is_gain_available() else 0.0
    told: dict[str, object] = {
        "pixel_format": camera.get_pixel_format_as_string(),
        "region": [x, y, width, height],
        "exposure_us": camera.get_exposure_time(),
        "gain_db": gain if _knows_db(camera) else 0.0,
        "gain": gain,
        "gain_unit": gain_unit(camera),
        "packet_size": camera.gv_get_packet_size() if camera.is_gv_device() else None,
    }
    for name in ("TriggerSource", "TriggerActivation", "DeviceFirmwareVersion"):
        if camera.is_feature_available(name):
            told[name] = camera.get_string(name)
    if camera.is_gv_device() and camera.is_feature_available("GevSCPD"):
        told["packet_delay_us"] = camera.gv_get_packet_delay() / 1000
    return told


def require_settings(camera: Any, wanted_us: float, applied: Applied) -> tuple[float, float]:
    """Read exposure (µs) and gain (camera's unit); CameraError when they or the region are not as set."""
    exposure_us, region = float(camera.get_exposure_time()), _region(camera)
    gain = float(camera.get_gain()) if camera.is_gain_available() else 0.0
    exposed = abs(exposure_us - wanted_us) <= _EXPOSURE_TOLERANCE * wanted_us
    if not exposed or abs(gain - applied.gain) > _GAIN_TOLERANCE or region != applied.region:
        unit = " dB" if applied.gain_in_db else ""
        raise CameraError(
            "settings-changed",
            found=f"{exposure_us:g} µs, gain {gain:g}{unit}, region {region}",
            wanted=f"{wanted_us:g} µs, gain {applied.gain:g}{unit}, region {applied.region}",
            exposure_us=exposure_us,
            wanted_exposure_us=wanted_us,
        )
    return exposure_us, gain


def _region(camera: Any) -> Region:
    found = camera.get_region()
    return found.x, found.y, found.width, found.height
