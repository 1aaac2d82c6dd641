"""Options of a simulated cell, as `station serve` and `station demo` take them."""

from __future__ import annotations

from typing import Annotated, get_args

import typer

from recordings.schema.messages import Mount
from station.cell.config import ControlPath
from station.cell.errors import ConfigError
from station.simulation.cell import NoiseLevel, SceneName

_RANGES = {"scene": SceneName, "noise": NoiseLevel, "mount": Mount, "control": ControlPath}
Seed = Annotated[int, typer.Option(help="Simulated: seed of camera pose, board pose, intrinsics, noise")]
Scene = Annotated[str, typer.Option(help="Simulated: paper, blog or paper-binned (640×512)")]
Noise = Annotated[str, typer.Option(help="Simulated: low, mid or high")]
Mounting = Annotated[str, typer.Option("--mount", help="Simulated: eye-in-hand or eye-to-hand")]
GigE = Annotated[bool, typer.Option("--gige", help="Simulated: the camera over GigE Vision packets")]

Control = Annotated[str | None, typer.Option("--control", hidden=True)]


def require_choices(**chosen: str | None) -> None:
    """ConfigError for a word that is not one of the offered ones; None is no choice."""
    for name, word in chosen.items():
        if word is not None and word not in (known := get_args(_RANGES[name])):
            raise ConfigError(
                f"--{name} {word} is unknown.", code="usage", remedy=f"Choose one of {', '.join(known)}."
            )
