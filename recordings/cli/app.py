"""All commands of `recordings`: where each one lives, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup
from recordings.cli.offered import offered

RECORDINGS = LazyGroup(
    {
        "info": LazyCommand(
            "recordings.cli.commands:info_command",
            "Show contents, rates and gaps. Exit 3: segment missing.",
            ("recordings info session.mcap", "recordings info SESSION-FOLDER --json"),
        ),
        "import": offered("import"),
        "export": LazyCommand(
            "recordings.cli.commands:export_command",
            "Write images and poses, or a ROS 2 bag.",
            (
                "recordings export session.mcap --to folder -o images  # edit, then import",
                "recordings export session.mcap --to ros2 -o bag",
            ),
        ),
        "recover": LazyCommand(
            "recordings.cli.commands:recover_command",
            "Rebuild an unfinished, cut or damaged recording. Exit 3: rebuilt.",
            ("recordings recover session.mcap.part", "recordings recover cut.mcap -o saved.mcap"),
        ),
    },
    help="Look into, make, convert and rescue recordings.",
    epilog="Exit codes: 0 good, 1 failed, 2 wrong usage, 3 done with loss.",
    files={
        "SESSION/session.mcap": "A recording; session-2.mcap and so on where the session was interrupted.",
        "SESSION/session.mcap.part": "One that was never finished: `recordings recover` rebuilds it.",
        "FOLDER/dataset.yaml, FOLDER/poses.csv": "Pictures and poses, to be imported, or as exported.",
    },
    environment={"NO_COLOR": "No colours."},
)
