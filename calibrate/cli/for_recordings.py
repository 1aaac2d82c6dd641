"""Commands of `recordings` that need what this package knows: `pyproject.toml` names them as entry points."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand

IMPORT = LazyCommand(
    "calibrate.cli.importing:import_command",  # the board in the images judges how poses are read
    "Turn other people's images and poses into a recording.",
    (
        "recordings import FOLDER -o mine.mcap",
        "recordings import FOLDER --dry-run  # says what would be taken, and why",
        "recordings import FOLDER --mount eye-in-hand --convention kuka-abc -o mine.mcap",
        "recordings import BAG --dataset dataset.yaml --flange tool0 -o mine.mcap",
    ),
)
