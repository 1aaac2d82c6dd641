"""A cell that plays a recording: the robot stands where it stood, the camera shows what it saw."""

from __future__ import annotations

from pathlib import Path

import msgspec

from recordings import strict_yaml
from recordings.errors import RecordingError
from recordings.reader import open_recording
from station.cell.config import StationConfig
from station.cell.errors import ConfigError
from station.devices.cell import Cell
from station.devices.playback import PlaybackCamera, PlaybackRobot

CONFIG_NAME = "config.yaml"


def playback_cell(recording: Path) -> Cell:
    """Everything is marked as playback; its plan is the recorded poses.

    RobotError or ConfigError for a recording that is damaged, has no joints or no configuration in it.
    """
    robot = PlaybackRobot(recording)
    try:
        content = open_recording(recording).attachments().get(CONFIG_NAME, b"")
        recorded = strict_yaml.load(content, StationConfig)
    except (RecordingError, strict_yaml.StrictYamlError) as error:
        raise ConfigError(
            f"{recording} holds no usable {CONFIG_NAME} of a station ({error}): it cannot be replayed as a "
            "cell. `calibrate solve` and Foxglove need none"
        ) from error
    camera = msgspec.structs.replace(
        recorded.camera, driver="playback", device=str(recording), trigger="software", playback_pace=0.0
    )
    config = msgspec.structs.replace(
        recorded,
        name="playback",
        camera=camera,
        trigger=None,
        robot=msgspec.structs.replace(recorded.robot, host="", serial=""),
    )
    return Cell(
        config=config,
        robot=robot,
        camera=PlaybackCamera(camera, robot),
        source="playback",
        plan=robot.plan(),
    )
