"""All commands of `calibrate`: where each one lives, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

_SOLVE, _FILES = "calibrate.cli.solve", "calibrate.cli.installed"
_NO_TIME_OFFSET = {"--time-offset": "Poses are taken at rest: leave it out."}
_ONE_KIND = {"--cell": "A root holds one kind of cell: leave it out."}
_GONE_FROM_SOLVE = {
    "--accept-move": "The message names what moved and when. Record again.",
    **_NO_TIME_OFFSET,
}
COMMANDS = {
    "solve": LazyCommand(
        f"{_SOLVE}:solve",
        (
            "calibrate solve session.mcap -o cell.yaml --report cell.html",
            "calibrate solve session.mcap -o cell.yaml --without 3,7",
        ),
        gone=_GONE_FROM_SOLVE,
    ),
    "compare": LazyCommand(
        f"{_SOLVE}:compare",
        ("calibrate compare session.mcap", "calibrate compare session.mcap --camera cell.yaml"),
        gone=_NO_TIME_OFFSET,
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
        gone={"--cell-config": "Leave it out: programs name their robot and camera to load_installed."},
    ),
    "list": LazyCommand(
        f"{_FILES}:list_installed", ("calibrate list", "calibrate list --root my-cell"), gone=_ONE_KIND
    ),
    "rollback": LazyCommand(
        f"{_FILES}:rollback",
        ("calibrate rollback --reason 'camera was knocked'", "calibrate rollback 3"),
        gone=_ONE_KIND,
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
            "calibrate board --kind charuco --columns 12 --rows 9 --square-mm 30 --marker-mm 22 -o board.svg",
            "calibrate board --kind april-tag --id 3 --square-mm 120 -o tag.pdf",
        ),
    ),
    "batch": LazyCommand(
        "calibrate.cli.batch:batch",
        (
            "calibrate batch monday.mcap tuesday.mcap -o results",
            "calibrate batch sessions/* -o results --workers 2  # each worker needs the memory of a solve",
        ),
        gone={
            "--scheduler-file": "Give --scheduler the address in it.",
            **dict.fromkeys(
                ("--tls-ca", "--tls-cert", "--tls-key"),
                "Name it in Dask's configuration: distributed.comm.tls.",
            ),
        },
        rare=True,
    ),
}
CALIBRATE = LazyGroup(
    COMMANDS,
    help="From a recording to a calibration that can be trusted, installed and undone.",
    epilog="Exit codes: 0 good, 1 failed, 2 usage, 3 done with loss, 4 gate failed.",
    gone={
        "check": "Use drift-check.",
        "diff": "`calibrate show` shows each; `calibrate install` tells how far it is from the one before.",
        "fleet": "Run `calibrate list --json` on each cell.",
        "metrics": "Use `calibrate list --json`: versions, validity and σ of every camera.",
        "report": "Use `calibrate solve REC --report FILE`.",
        "watch": "`calibrate drift-check FOLDER` tests production pictures; run it from a timer.",
        "sweep": "Frame times carry their own bound; `station doctor` shows it.",
    },
)
