"""All commands of `calibrate`: where each one lives, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

COMMANDS = {
    "solve": LazyCommand(
        "calibrate.cli.solve:solve",
        "Solve a recording and write the calibration file.",
        (
            "calibrate solve session.mcap -o cell.yaml --report cell.html",
            "calibrate solve session.mcap -o cell.yaml --without 3,7",
        ),
    ),
    "compare": LazyCommand(
        "calibrate.cli.solve:compare",
        "Compare all methods on the same views.",
        ("calibrate compare session.mcap", "calibrate compare session.mcap --camera cell.yaml"),
    ),
    "show": LazyCommand(
        "calibrate.cli.installed:show",
        "Show a calibration: verdict, result, gates, validity.",
        ("calibrate show  # the installed one", "calibrate show cell.yaml"),
    ),
    "export": LazyCommand(
        "calibrate.cli.installed:export",
        "Write a calibration as another program or pendant reads it.",
        (
            "calibrate export --to ros-launch -o camera.launch.py  # of what is installed",
            "calibrate export cell.yaml --to ros-camera-info -o camera_info.yaml",
            "calibrate export --as kuka-abc  # or ur-pendant, fanuc-xyzwpr, abb-quaternion …",
        ),
    ),
    "install": LazyCommand(
        "calibrate.cli.installed:install",
        "Make a calibration the installed one.",
        (
            "calibrate install cell.yaml",
            "calibrate install mine.yaml --cell imported --root my-cell  # of your own images",
        ),
    ),
    "list": LazyCommand(
        "calibrate.cli.installed:list_installed",
        "List every calibration that was installed here.",
        ("calibrate list", "calibrate list --root my-cell"),
    ),
    "rollback": LazyCommand(
        "calibrate.cli.installed:rollback",
        "Go back to an older installed calibration.",
        ("calibrate rollback --reason 'camera was knocked'", "calibrate rollback 3"),
    ),
    "withdraw": LazyCommand(
        "calibrate.cli.installed:withdraw",
        "Take the installed calibration out of use.",
        ("calibrate withdraw 'a pallet hit the camera'",),
        rare=True,
    ),
    "follow": LazyCommand(
        "calibrate.cli.follow:follow",
        "Print the installed calibration as JSON, and again after every change.",
        ("calibrate follow --camera overhead",),
        rare=True,
    ),
    "drift-check": LazyCommand(
        "calibrate.cli.drift_check:drift_check",
        "Test the installed calibration on new views.",
        ("calibrate drift-check later.mcap", "calibrate drift-check production-pictures --board tag.yaml"),
    ),
    "annotate": LazyCommand(
        "calibrate.cli.annotate:annotate",
        "Draw a calibration into a recording, for Foxglove, Lichtblick or rerun.",
        ("calibrate annotate session.mcap calibration.yaml -o seen.mcap",),
        rare=True,
    ),
    "board": LazyCommand(
        "calibrate.cli.board:board",
        "Write a board to print (PDF, SVG) or for a simulator (PNG, PPM).",
        (
            "calibrate board -o board.pdf --paper A4",
            "calibrate board 'charuco 12x9 30 22' -o board.svg",
            "calibrate board 'april-tag 120 3' -o tag.pdf",
        ),
    ),
    "batch": LazyCommand(
        "calibrate.cli.batch:batch",
        "Solve many recordings; resumable.",
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
    files={
        "ROOT/calibrations/current": "The installed calibration, which programs read. ROOT is `--root`, else "
        "$STATE_DIRECTORY, else ~/.local/state/calibration-station; /var/lib/station of the service.",
        "ROOT/calibrations/gen/": "Every calibration that was ever installed; they never change.",
        "ROOT/calibrations/validity.jsonl": "Who installed, undid or withdrew what, when and why.",
        "ROOT/calibrations/checks.jsonl": "Every drift check.",
        "ROOT/calibrations/cameras/NAME/": "The same for every camera that is not named main.",
    },
    environment={
        "STATE_DIRECTORY": "State folder, as systemd tells it; `--root` names another.",
        "XDG_STATE_HOME": "In place of ~/.local/state.",
        "NO_COLOR": "No colours.",
    },
)
