"""The GenICam description that the emulated camera serves, and where its registers lie.

Standard features by the names of the SFNC, over the bootstrap registers of GigE Vision where there is one,
else over registers of the maker's own from OWN on.
"""

from __future__ import annotations

import io
import zipfile

OWN = 0x0001_0000
XML_AT = 0x0010_0000
(
    WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, PIXEL_FORMAT, ACQUISITION, SENSOR_WIDTH, SENSOR_HEIGHT,
    EXPOSURE_AUTO, GAIN_AUTO, TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_ACTIVATION,
    TRIGGER_SOFTWARE, PAYLOAD_SIZE, CHUNK_MODE, CHUNK_SELECTOR, CHUNK_ENABLE, LINE_SELECTOR, LINE_MODE,
    LINE_SOURCE, LINE_INVERTER, FRAME_RATE_ENABLE, LOCKED, ACQUISITION_MODE, GAIN_SELECTOR,
) = range(OWN, OWN + 27 * 4, 4)  # fmt: skip
EXPOSURE, GAIN, FRAME_RATE, TRIGGER_DELAY = range(OWN + 0x100, OWN + 0x100 + 4 * 8, 8)
"""IEEE doubles of eight bytes each"""
TICK_HZ, TIMESTAMP_CONTROL, TIMESTAMP = 0x93C, 0x944, 0x948
GVSP_CONFIGURATION = 0x960
PACKET_SIZE, PACKET_DELAY = 0xD04, 0xD08

PIXEL_FORMATS = {
    "Mono8": 0x01080001, "Mono10": 0x01100003, "Mono10Packed": 0x010C0004, "Mono12": 0x01100005,
    "Mono12Packed": 0x010C0006, "Mono10p": 0x010A0046, "Mono12p": 0x010C0047, "Mono16": 0x01100007,
    "BayerGR8": 0x01080008, "BayerRG8": 0x01080009, "BayerGB8": 0x0108000A, "BayerBG8": 0x0108000B,
    "RGB8": 0x02180014, "BGR8": 0x02180015,
}  # fmt: skip
CHUNKS = {"Image": 0x0001, "Timestamp": 0xA001, "ExposureTime": 0xA002, "FrameID": 0xA003, "Gain": 0xA004}
TRIGGER_SOURCES = {"Software": 0, "Line1": 1, "Line2": 2, "Line3": 3, "Line0": 4}
_LINES = {f"Line{number}": number for number in range(4)}
_AUTO = {"Off": 0, "Once": 1, "Continuous": 2}


def genicam_xml(serial: str) -> str:
    """The whole document; a value read from `Device` is never cached."""
    features = [
        *(_string(f"Device{n}", at, size) for n, at, size in (
            ("VendorName", 0x48, 32), ("ModelName", 0x68, 32), ("Version", 0x88, 32),
            ("ManufacturerInfo", 0xA8, 48), ("SerialNumber", 0xD8, 16), ("UserID", 0xE8, 16))),
        _string("DeviceFirmwareVersion", 0x88, 32),
        _integer("SensorWidth", SENSOR_WIDTH, access="RO"),
        _integer("SensorHeight", SENSOR_HEIGHT, access="RO"),
        _integer("Width", WIDTH, "<Min>16</Min><pMax>SensorWidth</pMax><Inc>16</Inc>"),
        _integer("Height", HEIGHT, "<Min>2</Min><pMax>SensorHeight</pMax><Inc>2</Inc>"),
        _integer("OffsetX", OFFSET_X, "<Min>0</Min><pMax>SensorWidth</pMax>"),
        _integer("OffsetY", OFFSET_Y, "<Min>0</Min><pMax>SensorHeight</pMax>"),
        _enumeration("PixelFormat", PIXEL_FORMAT, PIXEL_FORMATS),
        _integer("PayloadSize", PAYLOAD_SIZE, access="RO"),
        _enumeration("AcquisitionMode", ACQUISITION_MODE, {"SingleFrame": 1, "Continuous": 2}),
        _command("AcquisitionStart", ACQUISITION, 1),
        _command("AcquisitionStop", ACQUISITION, 0),
        _boolean("AcquisitionFrameRateEnable", FRAME_RATE_ENABLE),
        _float("AcquisitionFrameRate", FRAME_RATE, 0.5, 500.0, "Hz"),
        _float("ExposureTime", EXPOSURE, 10.0, 1e6, "us"),
        _enumeration("ExposureAuto", EXPOSURE_AUTO, _AUTO),
        _enumeration("GainSelector", GAIN_SELECTOR, {"All": 0}),
        _float("Gain", GAIN, 0.0, 24.0, "dB"),
        _enumeration("GainAuto", GAIN_AUTO, _AUTO),
        _enumeration("TriggerSelector", TRIGGER_SELECTOR, {"FrameStart": 0}),
        _enumeration("TriggerMode", TRIGGER_MODE, {"Off": 0, "On": 1}),
        _enumeration("TriggerSource", TRIGGER_SOURCE, TRIGGER_SOURCES),
        _enumeration("TriggerActivation", TRIGGER_ACTIVATION, {"RisingEdge": 0, "FallingEdge": 1}),
        _float("TriggerDelay", TRIGGER_DELAY, 0.0, 1e6, "us"),
        _command("TriggerSoftware", TRIGGER_SOFTWARE, 1),
        _enumeration("LineSelector", LINE_SELECTOR, _LINES),
        _enumeration("LineMode", LINE_MODE, {"Input": 0, "Output": 1}),
        _enumeration("LineSource", LINE_SOURCE, {"Off": 0, "ExposureActive": 1}),
        _boolean("LineInverter", LINE_INVERTER),
        _boolean("ChunkModeActive", CHUNK_MODE),
        _enumeration("ChunkSelector", CHUNK_SELECTOR, {name: n for n, name in enumerate(CHUNKS)}),
        _boolean("ChunkEnable", CHUNK_ENABLE),
        _chunk("Timestamp", "<IntReg", "<Sign>Unsigned</Sign>"),
        _chunk("ExposureTime", "<FloatReg"),
        _chunk("FrameID", "<IntReg", "<Sign>Unsigned</Sign>"),
        _chunk("Gain", "<FloatReg"),
        _command("GevTimestampControlLatch", TIMESTAMP_CONTROL, 2),
        _integer("GevTimestampValue", TIMESTAMP, access="RO", length=8),
        _integer("GevTimestampTickFrequency", TICK_HZ, access="RO", length=8),
        _masked("GevGVSPExtendedIDMode", GVSP_CONFIGURATION, "<Bit>1</Bit>", "Enumeration",
                _entries({"Off": 0, "On": 1})),
        _masked("GevSCPSPacketSize", PACKET_SIZE, "<LSB>31</LSB><MSB>16</MSB>", "Integer",
                "<Min>576</Min><Max>16000</Max><Inc>4</Inc>"),
        _masked("GevSCPSFireTestPacket", PACKET_SIZE, "<Bit>0</Bit>", "Command",
                "<CommandValue>1</CommandValue>"),
        _integer("GevSCPD", PACKET_DELAY),
        _integer("GevHeartbeatTimeout", 0x938),
        _integer("TLParamsLocked", LOCKED),
    ]  # fmt: skip
    names = "".join(f"<pFeature>{f.split(chr(39), 2)[1]}</pFeature>" for f in features)
    return (
        "<?xml version='1.0' encoding='utf-8'?><RegisterDescription ModelName='Emulated' VendorName='Judge' "
        "StandardNameSpace='GEV' SchemaMajorVersion='1' SchemaMinorVersion='1' SchemaSubMinorVersion='0' "
        "MajorVersion='1' MinorVersion='0' SubMinorVersion='0' "
        f"ProductGuid='{serial}' VersionGuid='0' xmlns='http://www.genicam.org/GenApi/Version_1_1'>"
        f"<Category Name='Root' NameSpace='Standard'>{names}</Category>{''.join(features)}"
        "<Port Name='Device' NameSpace='Standard'/></RegisterDescription>"
    )


def zipped(xml: str) -> bytes:
    """Pack it in the form that most cameras keep."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("camera.xml", xml)
    return packed.getvalue()


def _place(at: int, length: int, access: str, port: str = "Device") -> str:
    return (
        f"<Address>{at:#x}</Address><Length>{length}</Length><AccessMode>{access}</AccessMode>"
        f"<pPort>{port}</pPort><Cachable>NoCache</Cachable>"
    )


def _string(name: str, at: int, length: int) -> str:
    return f"<StringReg Name='{name}' NameSpace='Standard'>{_place(at, length, 'RO')}</StringReg>"


def _integer(
    name: str, at: int, bounds: str = "", access: str = "RW", length: int = 4, sign: str = "Unsigned"
) -> str:
    return (
        f"<Integer Name='{name}' NameSpace='Standard'><pValue>{name}Reg</pValue>{bounds}</Integer>"
        f"<IntReg Name='{name}Reg'>{_place(at, length, access)}<Sign>{sign}</Sign>"
        "<Endianess>BigEndian</Endianess></IntReg>"
    )


def _masked(name: str, at: int, bits: str, kind: str, more: str = "") -> str:
    value = f"<pValue>{name}Reg</pValue>"
    inside = value + more if kind in ("Integer", "Command") else more + value
    return (
        f"<{kind} Name='{name}' NameSpace='Standard'>{inside}</{kind}>"
        f"<MaskedIntReg Name='{name}Reg'>{_place(at, 4, 'RW')}{bits}"
        "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></MaskedIntReg>"
    )


def _entries(values: dict[str, int]) -> str:
    return "".join(f"<EnumEntry Name='{n}'><Value>{v}</Value></EnumEntry>" for n, v in values.items())


def _enumeration(name: str, at: int, values: dict[str, int], access: str = "RW") -> str:
    return (
        f"<Enumeration Name='{name}' NameSpace='Standard'>{_entries(values)}<pValue>{name}Reg</pValue>"
        f"</Enumeration><IntReg Name='{name}Reg'>{_place(at, 4, access)}<Sign>Unsigned</Sign>"
        "<Endianess>BigEndian</Endianess></IntReg>"
    )


def _boolean(name: str, at: int) -> str:
    return (
        f"<Boolean Name='{name}' NameSpace='Standard'><pValue>{name}Reg</pValue></Boolean>"
        f"<IntReg Name='{name}Reg'>{_place(at, 4, 'RW')}<Sign>Unsigned</Sign>"
        "<Endianess>BigEndian</Endianess></IntReg>"
    )


def _command(name: str, at: int, value: int) -> str:
    return (
        f"<Command Name='{name}' NameSpace='Standard'><pValue>{name}Reg</pValue>"
        f"<CommandValue>{value}</CommandValue></Command>"
        f"<IntReg Name='{name}Reg'>{_place(at, 4, 'RW')}<Sign>Unsigned</Sign>"
        "<Endianess>BigEndian</Endianess></IntReg>"
    )


def _float(name: str, at: int, low: float, high: float, unit: str) -> str:
    return (
        f"<Float Name='{name}' NameSpace='Standard'><pValue>{name}Reg</pValue><Min>{low}</Min>"
        f"<Max>{high}</Max><Unit>{unit}</Unit></Float>"
        f"<FloatReg Name='{name}Reg'>{_place(at, 8, 'RW')}<Endianess>BigEndian</Endianess></FloatReg>"
    )


def _chunk(name: str, kind: str, more: str = "") -> str:
    """A value at the start of a chunk of eight bytes, behind a port of its own."""
    return (
        f"{kind} Name='Chunk{name}' NameSpace='Standard'>{_place(0, 8, 'RO', f'Chunk{name}Port')}{more}"
        f"<Endianess>BigEndian</Endianess></{kind[1:]}>"
        f"<Port Name='Chunk{name}Port'><ChunkID>{CHUNKS[name]:x}</ChunkID></Port>"
    )
