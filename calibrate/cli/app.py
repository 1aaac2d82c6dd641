"""All commands of `calibrate`: name → module and short help. Only a called one is loaded."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

_SOLVE, _FILES = "calibrate.cli.solve", "calibrate.cli.installed"
COMMANDS = {
    "solve": LazyCommand(
        f"{_SOLVE}:solve",
        "Solve a recording and write the calibration file.",
        (
            "calibrate solve session.mcap -o cell.yaml --report cell.html",
            "calibrate solve session.mcap -o cell.yaml --without 3,7",
        ),
    ),
    "compare": LazyCommand(
        f"{_SOLVE}:compare",
        "Compare all methods on the same views.",
        ("calibrate compare session.mcap", "calibrate compare session.mcap --camera cell.yaml"),
    ),
    "report": LazyCommand(
        f"{_SOLVE}:report",
        "Solve a recording again and write its report: one HTML file.",
        ("calibrate report session.mcap -o cell.html",),
    ),
    "show": LazyCommand(
        f"{_FILES}:show",
        "Show a calibration: verdict, result, gates; of the installed one whether it still holds.",
        ("calibrate show  # the installed one", "calibrate show cell.yaml"),
    ),
    "diff": LazyCommand(
        f"{_FILES}:diff",
        "Compare two calibrations with their uncertainty.",
        ("calibrate diff cell.yaml  # and the installed one", "calibrate diff a.yaml b.yaml"),
    ),
    "export": LazyCommand(
        f"{_FILES}:export",
        "Write a calibration in another program's format.",
        (
            "calibrate export --to ros-launch-follow -o camera.launch.py  # follows what is installed",
            "calibrate export cell.yaml --to ros-camera-info -o camera_info.yaml",
        ),
    ),
    "install": LazyCommand(
        f"{_FILES}:install",
        "Make a calibration the installed one.",
        (
            "calibrate install cell.yaml --cell-config station.yaml",
            "calibrate install mine.yaml --cell imported --root my-cell  # of your own images",
        ),
    ),
    "list": LazyCommand(
        f"{_FILES}:list_installed",
        "List every calibration that was installed here.",
        ("calibrate list", "calibrate list --root my-cell"),
    ),
    "rollback": LazyCommand(
        f"{_FILES}:rollback",
        "Go back to an older installed calibration.",
        ("calibrate rollback --reason 'camera was knocked'", "calibrate rollback 3"),
    ),
    "withdraw": LazyCommand(
        f"{_FILES}:withdraw",
        "Take the installed calibration out of use.",
        ("calibrate withdraw 'a pallet hit the camera'",),
    ),
    "metrics": LazyCommand(
        "calibrate.cli.metrics:metrics",
        "Print the state of the installed calibrations for Prometheus.",
        ("calibrate metrics", "calibrate metrics -o /var/lib/node_exporter/calibration.prom"),
    ),
    "follow": LazyCommand(
        "calibrate.cli.follow:follow",
        "Print the installed calibration as JSON, and again after every change.",
        ("calibrate follow --camera overhead",),
    ),
    "drift-check": LazyCommand(
        "calibrate.cli.drift_check:drift_check",
        "Test the installed calibration on new views.",
        ("calibrate drift-check later.mcap", "calibrate drift-check later.mcap --calibration cell.yaml"),
    ),
    "watch": LazyCommand(
        "calibrate.cli.watch:watch",
        "Notice in production images that camera, tag or arm moved.",
        (
            "calibrate watch monday.mcap --board tag.yaml",
            "calibrate watch pictures --follow  # until Ctrl-C; dataset.yaml states the tag",
        ),
    ),
    "annotate": LazyCommand(
        "calibrate.cli.annotate:annotate",
        "Draw a calibration into a recording, for Foxglove, Lichtblick or rerun.",
        ("calibrate annotate session.mcap calibration.yaml -o seen.mcap",),
    ),
    "board": LazyCommand(
        "calibrate.cli.board:board",
        "Write a printable board (PDF or SVG, true scale).",
        (
            "calibrate board -o board.pdf --paper A4",
            "calibrate board --kind charuco --columns 12 --rows 9 --square-mm 30 --marker-mm 22 -o board.svg",
            "calibrate board --kind april-tag --id 3 --square-mm 120 -o tag.pdf",
        ),
    ),
    "batch": LazyCommand(
        "calibrate.cli.batch:batch",
        "Solve many recordings; resumable.",
        (
            "calibrate batch monday.mcap tuesday.mcap -o results",
            "calibrate batch sessions/* -o results --workers 2  # each worker needs the memory of a solve",
            "calibrate batch 's3://robots/sessions/*.mcap' -o s3://robots/results",
        ),
    ),
    "fleet": LazyCommand(
        "calibrate.cli.batch:fleet",
        "Collect validity and drift of many cells into one table and one page.",
        (
            "calibrate fleet cells/* -o fleet  # copies of the cells' state folders",
            "calibrate fleet 's3://robots/cells/*' -o s3://robots/fleet",
        ),
    ),
    "sweep": LazyCommand(
        "calibrate.cli.sweep:sweep",
        "Test the time of a camera's frames against the robot's.",
        ("calibrate sweep sweep.mcap", "calibrate sweep sweep.mcap --calibration cell.yaml"),
    ),
}
CALIBRATE = LazyGroup(
    COMMANDS,
    help="From a recording to a calibration that can be trusted, installed and undone.\n\n"
    "First: calibrate solve REC -o cell.yaml --report cell.html, then calibrate install cell.yaml. Your own "
    "images become a recording by: recordings import FOLDER -o REC.",
    epilog="Exit codes: 0 good, 1 failed, 2 wrong usage or configuration, 3 done with loss, 4 a gate or a "
    "drift check failed.",
    aliases={"check": "drift-check"},
)
