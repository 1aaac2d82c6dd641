"""All commands of `recordings`: where each one lives, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

RECORDINGS = LazyGroup(
    {
        "info": LazyCommand(
            "recordings.cli.commands:info_command",
            ("recordings info session.mcap", "recordings info SESSION-FOLDER --json"),
        ),
        "import": LazyCommand(
            "calibrate.cli.importing:import_command",  # the board in the images judges how poses are read
            (
                "recordings import FOLDER -o mine.mcap",
                "recordings import FOLDER --dry-run  # says what would be taken, and why",
                "recordings import FOLDER --mount eye-in-hand --convention kuka-abc -o mine.mcap",
                "recordings import BAG --dataset dataset.yaml --flange tool0 -o mine.mcap",
            ),
        ),
        "export": LazyCommand(
            "recordings.cli.commands:export_command",
            (
                "recordings export session.mcap --to folder -o images  # edit, then import",
                "recordings export session.mcap --to ros2 -o bag",
            ),
        ),
        "recover": LazyCommand(
            "recordings.cli.commands:recover_command",
            ("recordings recover session.mcap.part", "recordings recover cut.mcap -o saved.mcap"),
        ),
    },
    help="Look into, make, convert and rescue recordings.",
    epilog="Exit codes: 0 good, 1 failed, 2 wrong usage, 3 done with loss.",
)
