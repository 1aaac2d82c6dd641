"""The GenICam description of the simulated GigE camera: features of a MER-131-75GM over Aravis's registers.

Addresses below 0xA000 are those Aravis's fake camera acts on; the others are memory that the simulation
itself watches.
"""

from __future__ import annotations

from xml.sax.saxutils import escape

VENDOR, MODEL = "Daheng Imaging", "MER-131-75GM"
VENDOR_ADDRESS, MODEL_ADDRESS, VERSION_ADDRESS, INFO_ADDRESS, SERIAL_ADDRESS = 0x48, 0x68, 0x88, 0xA8, 0xD8
SENSOR_HEIGHT, SENSOR_WIDTH = 0x118, 0x11C
WIDTH, HEIGHT, GAIN, EXPOSURE = 0x100, 0x104, 0x110, 0x120
ACQUISITION, PIXEL_FORMAT, FRAME_PERIOD = 0x124, 0x128, 0x138
TIMESTAMP_LATCH, TIMESTAMP_VALUE, EXPOSURE_AUTO, GAIN_AUTO = 0xA000, 0xA008, 0xA010, 0xA014
TRIGGER_SOURCE, FIRST_FREE = 0xA018, 0xA01C
TRIGGER_PULSE, FAKE_TRIGGER_SOURCE = 0x30C, 0x304
FAKE_TRIGGER_SOFTWARE = 1
"""The only source Aravis's fake camera reacts to: pulses on a line are written to TRIGGER_PULSE, too."""
PIXEL_FORMATS = {
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono10Packed": 0x010C0004,
    "Mono12": 0x01100005,
    "Mono12Packed": 0x010C0006,
    "BayerGR8": 0x01080008,
    "BayerRG8": 0x01080009,
    "BayerGB8": 0x0108000A,
    "BayerBG8": 0x0108000B,
    "RGB8": 0x02180014,
}
TICK_HZ = 1_000_000_000
"""The real camera's tick is another; Aravis's simulator sends nanoseconds whatever is said here."""
GAIN_STEPS_PER_DB = 10
_TRIGGER_SELECTOR = (
    "<Enumeration Name='TriggerSelector' NameSpace='Standard'>"
    "<EnumEntry Name='FrameStart'><Value>0</Value></EnumEntry>"
    "<pValue>TriggerSelectorValue</pValue></Enumeration>"
    "<Integer Name='TriggerSelectorValue'><Value>0</Value></Integer>"
)
_PAYLOAD_SIZE = (
    "<IntSwissKnife Name='PayloadSize' NameSpace='Standard'><pVariable Name='W'>Width</pVariable>"
    "<pVariable Name='H'>Height</pVariable><pVariable Name='F'>PixelFormat</pVariable>"
    "<Formula>W * H * ((F &gt;&gt; 16) &amp; 0xFF) / 8</Formula></IntSwissKnife>"
)


def genicam_xml() -> str:
    """The whole document."""
    parts = [
        _strings(),
        _integer("SensorWidth", SENSOR_WIDTH, access="RO"),
        _integer("SensorHeight", SENSOR_HEIGHT, access="RO"),
        _integer("OffsetX", 0x130, "<Min>0</Min><pMax>SensorWidth</pMax>"),
        _integer("OffsetY", 0x134, "<Min>0</Min><pMax>SensorHeight</pMax>"),
        _integer("Width", WIDTH, "<Min>8</Min><pMax>SensorWidth</pMax><Inc>8</Inc>"),
        _integer("Height", HEIGHT, "<Min>2</Min><pMax>SensorHeight</pMax><Inc>2</Inc>"),
        _enumeration("PixelFormat", PIXEL_FORMAT, PIXEL_FORMATS),
        _enumeration("AcquisitionMode", 0x12C, {"Continuous": 1, "SingleFrame": 2, "MultiFrame": 3}),
        _command("AcquisitionStart", ACQUISITION, 1),
        _command("AcquisitionStop", ACQUISITION, 0),
        # Range checks ask for the converted smallest register, 0.
        _float(
            "AcquisitionFrameRate",
            FRAME_PERIOD,
            "1000000 / FROM",
            "1000000 / (TO + (TO = 0))",
            0.1,
            1000.0,
            "Hz",
        ),
        _float("ExposureTime", EXPOSURE, "FROM", "TO", 20.0, 1_000_000.0, "us"),
        _enumeration("ExposureAuto", EXPOSURE_AUTO, {"Off": 0, "Continuous": 1, "Once": 2}),
        _float("Gain", GAIN, f"FROM * {GAIN_STEPS_PER_DB}", f"TO / {GAIN_STEPS_PER_DB}.0", 0.0, 24.0, "dB"),
        _enumeration("GainAuto", GAIN_AUTO, {"Off": 0, "Continuous": 1, "Once": 2}),
        _TRIGGER_SELECTOR,
        _enumeration("TriggerMode", 0x300, {"Off": 0, "On": 1}),
        _enumeration("TriggerSource", TRIGGER_SOURCE, {"Line0": 0, "Software": 1, "Line2": 2, "Line3": 3}),
        _enumeration("TriggerActivation", 0x308, {"RisingEdge": 0}),
        _command("TriggerSoftware", TRIGGER_PULSE, 1),
        _command("GevTimestampControlLatch", TIMESTAMP_LATCH, 1),
        _integer("GevTimestampValue", TIMESTAMP_VALUE, access="RO", length=8),
        f"<Integer Name='GevTimestampTickFrequency' NameSpace='Standard'><Value>{TICK_HZ}</Value></Integer>",
        _PAYLOAD_SIZE,
        "<Integer Name='TLParamsLocked'><Value>0</Value><Min>0</Min><Max>1</Max></Integer>",
    ]
    names = [part.split("Name='", 1)[1].split("'", 1)[0] for part in parts[1:]]
    strings = ["DeviceVendorName", "DeviceModelName", "DeviceVersion", "DeviceManufacturerInfo", "DeviceID"]
    features = "".join(f"<pFeature>{name}</pFeature>" for name in strings + names)
    return (
        f"<?xml version='1.0' encoding='utf-8'?><RegisterDescription ModelName='{MODEL}' "
        f"VendorName='{escape(VENDOR)}' StandardNameSpace='GEV' SchemaMajorVersion='1' "
        "SchemaMinorVersion='1' SchemaSubMinorVersion='0' MajorVersion='1' "
        "MinorVersion='0' SubMinorVersion='0' "
        "ProductGuid='0' VersionGuid='0' xmlns='http://www.genicam.org/GenApi/Version_1_1'>"
        f"<Category Name='Root' NameSpace='Standard'>{features}</Category>{''.join(parts)}"
        "<Port Name='Device' NameSpace='Standard'/></RegisterDescription>"
    )


def _register(name: str, address: int, access: str, length: int = 4) -> str:
    return (
        f"<IntReg Name='{name}Register'><Address>{address:#x}</Address><Length>{length}</Length>"
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>"
        "<Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
    )


def _strings() -> str:
    names = {
        "DeviceVendorName": (VENDOR_ADDRESS, 32),
        "DeviceModelName": (MODEL_ADDRESS, 32),
        "DeviceVersion": (VERSION_ADDRESS, 32),
        "DeviceManufacturerInfo": (INFO_ADDRESS, 48),
        "DeviceID": (SERIAL_ADDRESS, 16),
    }
    return "".join(
        f"<StringReg Name='{name}' NameSpace='Standard'><Address>{address:#x}</Address>"
        f"<Length>{length}</Length><AccessMode>RO</AccessMode><pPort>Device</pPort></StringReg>"
        for name, (address, length) in names.items()
    )


def _integer(name: str, address: int, bounds: str = "", access: str = "RW", length: int = 4) -> str:
    return (
        f"<Integer Name='{name}' NameSpace='Standard'><pValue>{name}Register</pValue>{bounds}</Integer>"
        + _register(name, address, access, length)
    )


def _enumeration(name: str, address: int, entries: dict[str, int]) -> str:
    listed = "".join(f"<EnumEntry Name='{n}'><Value>{v}</Value></EnumEntry>" for n, v in entries.items())
    return (
        f"<Enumeration Name='{name}' NameSpace='Standard'>{listed}"
        f"<pValue>{name}Register</pValue></Enumeration>" + _register(name, address, "RW")
    )


def _command(name: str, address: int, value: int) -> str:
    return (
        f"<Command Name='{name}' NameSpace='Standard'><pValue>{name}Register</pValue>"
        f"<CommandValue>{value}</CommandValue></Command>" + _register(name, address, "RW")
    )


def _float(name: str, address: int, to: str, back: str, low: float, high: float, unit: str) -> str:
    """A float feature over an integer register: `to` and `back` are the converter's formulas."""
    return (
        f"<Float Name='{name}' NameSpace='Standard'><pValue>{name}Converter</pValue><Min>{low}</Min>"
        f"<Max>{high}</Max><Unit>{unit}</Unit></Float>"
        f"<Converter Name='{name}Converter'><FormulaTo>{to}</FormulaTo><FormulaFrom>{back}</FormulaFrom>"
        f"<pValue>{name}Register</pValue></Converter>" + _register(name, address, "RW")
    )
