"""All commands of `recordings`: where each one lives, its line of help, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

RECORDINGS = LazyGroup(
    {
        "info": LazyCommand(
            "recordings.cli.commands:info_command",
            "Show contents, rates, gaps and clock quality. Exit 3: segment missing.",
            ("recordings info session.mcap", "recordings info SESSION-FOLDER --json"),
        ),
        "import": LazyCommand(
            "recordings.cli.importing:import_command",
            "Turn other people's images and poses into a recording.",
            (
                "recordings import FOLDER -o mine.mcap",
                "recordings import BAG --dry-run  # says what would be taken",
                "recordings import BAG --dataset dataset.yaml --flange tool0 -o mine.mcap",
            ),
        ),
        "export": LazyCommand(
            "recordings.cli.commands:export_command",
            "Write a folder of images and poses, CSV tables, or a ROS 2 bag.",
            (
                "recordings export session.mcap --to csv -o tables",
                "recordings export session.mcap --to folder -o images  # edit, then import",
            ),
        ),
        "excerpt": LazyCommand(
            "recordings.cli.commands:excerpt_command",
            "Write a smaller recording that solves like the whole.",
            ("recordings excerpt session.mcap -o small.mcap",),
        ),
        "recover": LazyCommand(
            "recordings.cli.commands:recover_command",
            "Rebuild an unfinished, cut or damaged recording. Exit 3: it had to.",
            ("recordings recover session.mcap.part", "recordings recover cut.mcap -o saved.mcap"),
        ),
    },
    help="Look into, make, convert and rescue recordings.",
    epilog="Exit codes: 0 good, 1 failed, 2 wrong usage, 3 done with loss.",
)
