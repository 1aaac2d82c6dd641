"""All commands of `calibrate`: where each one lives, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

_SOLVE, _FILES = "calibrate.cli.solve", "calibrate.cli.installed"
COMMANDS = {
    "solve": LazyCommand(
        f"{_SOLVE}:solve",
        (
            "calibrate solve session.mcap -o cell.yaml --report cell.html",
            "calibrate solve session.mcap -o cell.yaml --without 3,7",
        ),
    ),
    "compare": LazyCommand(
        f"{_SOLVE}:compare",
        ("calibrate compare session.mcap", "calibrate compare session.mcap --camera cell.yaml"),
    ),
    "show": LazyCommand(
        f"{_FILES}:show", ("calibrate show  # the installed one", "calibrate show cell.yaml")
    ),
    "export": LazyCommand(
        f"{_FILES}:export",
        (
            "calibrate export --to ros-launch -o camera.launch.py  # of what is installed",
            "calibrate export cell.yaml --to ros-camera-info -o camera_info.yaml",
        ),
    ),
    "install": LazyCommand(
        f"{_FILES}:install",
        (
            "calibrate install cell.yaml",
            "calibrate install mine.yaml --cell imported --root my-cell  # of your own images",
        ),
    ),
    "list": LazyCommand(f"{_FILES}:list_installed", ("calibrate list", "calibrate list --root my-cell")),
    "rollback": LazyCommand(
        f"{_FILES}:rollback",
        ("calibrate rollback --reason 'camera was knocked'", "calibrate rollback 3"),
    ),
    "withdraw": LazyCommand(
        f"{_FILES}:withdraw", ("calibrate withdraw 'a pallet hit the camera'",), rare=True
    ),
    "follow": LazyCommand("calibrate.cli.follow:follow", ("calibrate follow --camera overhead",), rare=True),
    "drift-check": LazyCommand(
        "calibrate.cli.drift_check:drift_check",
        ("calibrate drift-check later.mcap", "calibrate drift-check production-pictures --board tag.yaml"),
    ),
    "annotate": LazyCommand(
        "calibrate.cli.annotate:annotate",
        ("calibrate annotate session.mcap calibration.yaml -o seen.mcap",),
        rare=True,
    ),
    "board": LazyCommand(
        "calibrate.cli.board:board",
        (
            "calibrate board -o board.pdf --paper A4",
            "calibrate board 'charuco 12x9 30 22' -o board.svg",
            "calibrate board 'april-tag 120 3' -o tag.pdf",
        ),
    ),
    "batch": LazyCommand(
        "calibrate.cli.batch:batch",
        (
            "calibrate batch monday.mcap tuesday.mcap -o results",
            "calibrate batch sessions/* -o results --workers 2  # each worker needs the memory of a solve",
        ),
        rare=True,
    ),
}
CALIBRATE = LazyGroup(
    COMMANDS,
    help="From a recording to a calibration that can be trusted, installed and undone.",
    epilog="Exit codes: 0 good, 1 failed, 2 usage, 3 done with loss, 4 gate failed.",
)
