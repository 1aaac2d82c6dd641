"""Options of a simulated cell, as `station serve` and `station demo` take them."""

from __future__ import annotations

from typing import Annotated

import typer

from recordings.schema.messages import Mount
from station.simulation.truth import NoiseLevel, SceneName

Seed = Annotated[int, typer.Option(min=0, help="Simulated: seed of poses, intrinsics, noise")]
Scene = Annotated[SceneName, typer.Option(help="Simulated: board and camera; paper-binned: 640×512 pixels")]
Noise = Annotated[NoiseLevel, typer.Option(help="Simulated: errors of robot and camera")]
Mounting = Annotated[Mount, typer.Option("--mount", help="Simulated: camera on flange or beside")]
GigE = Annotated[bool, typer.Option("--gige", help="Simulated: the camera over GigE Vision packets")]
