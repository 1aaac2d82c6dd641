"""The GenICam description that the emulated camera serves, and where its registers lie.

Standard features by the names of the SFNC, over the bootstrap registers of GigE Vision where there is one,
else over registers of the maker's own.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from xml.etree import ElementTree

XML_AT = 0x0010_0000
_TEXT = Path(__file__).with_name("camera.xml").read_text()
_ROOT, _GENICAM = ElementTree.fromstring(_TEXT), {"": "http://www.genicam.org/GenApi/Version_1_1"}


def _address(name: str) -> int:
    return int(_ROOT.findtext(f"*[@Name='{name}Reg']/Address", "", _GENICAM), 16)


def _values(name: str) -> dict[str, int]:
    entries = _ROOT.iterfind(f"Enumeration[@Name='{name}']/EnumEntry", _GENICAM)
    return {entry.attrib["Name"]: int(entry.findtext("Value", "", _GENICAM)) for entry in entries}


WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = map(_address, ("Width", "Height", "OffsetX", "OffsetY"))
SENSOR_WIDTH, SENSOR_HEIGHT = _address("SensorWidth"), _address("SensorHeight")
PIXEL_FORMAT, PAYLOAD_SIZE = _address("PixelFormat"), _address("PayloadSize")
ACQUISITION, ACQUISITION_MODE = _address("AcquisitionStart"), _address("AcquisitionMode")
EXPOSURE, EXPOSURE_AUTO, GAIN, GAIN_AUTO = map(_address, ("ExposureTime", "ExposureAuto", "Gain", "GainAuto"))
TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_ACTIVATION, TRIGGER_SOFTWARE = map(
    _address, ("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerSoftware")
)
LINE_SELECTOR, LINE_MODE, LINE_SOURCE = map(_address, ("LineSelector", "LineMode", "LineSource"))
TICK_HZ, TIMESTAMP = _address("GevTimestampTickFrequency"), _address("GevTimestampValue")
TIMESTAMP_CONTROL, GVSP_CONFIGURATION = (
    _address("GevTimestampControlLatch"),
    _address("GevGVSPExtendedIDMode"),
)
PACKET_SIZE, PACKET_DELAY = _address("GevSCPSPacketSize"), _address("GevSCPD")

PIXEL_FORMATS, TRIGGER_SOURCES = _values("PixelFormat"), _values("TriggerSource")


def zipped() -> bytes:
    """Pack it in the form that most cameras keep."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("camera.xml", _TEXT)
    return packed.getvalue()
