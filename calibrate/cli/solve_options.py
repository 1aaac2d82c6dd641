"""The options that several commands share, written once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibrate.handeye.solution import Profile

ProfileName = Annotated[Profile, typer.Option(help="robust: the station's; paper: the published method")]
Seed = Annotated[int, typer.Option(min=0, help="Random seed")]
BoardFile = Annotated[
    Path | None, typer.Option("--board", help="YAML of a board that replaces the recorded one")
]
CameraFile = Annotated[
    Path | None, typer.Option("--camera", help="Fixed intrinsics: camera_info YAML or a calibration file")
]
GatesFile = Annotated[Path | None, typer.Option("--gates", help="YAML of other gate limits")]
TimeLimit = Annotated[float, typer.Option(min=0.0, max=1e6, help="Time limit, s (0: none)")]
MemoryLimit = Annotated[int, typer.Option(min=0, max=2**30, help="Memory limit, MiB (0: none)")]
