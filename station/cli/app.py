"""All commands of `station`: where each one lives, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

STATION = LazyGroup(
    {
        "tui": LazyCommand(
            "station.cli.daemon:tui_command",
            ("station tui",),
        ),
        "demo": LazyCommand(
            "station.cli.demo:demo_command",
            ("station demo", "station demo --seed 3 --mount eye-to-hand --noise mid --out trial"),
        ),
        "serve": LazyCommand(
            "station.cli.serve:serve_command",
            (
                "station serve --config station.yaml  # then, in another terminal: station",
                "station serve --config station.yaml --rehearse  # the same with no hardware",
                "station serve --simulate --mount eye-to-hand --noise mid",
                "station serve --replay session.mcap",
            ),
        ),
        "plan": LazyCommand(
            "station.cli.plan:plan_command",
            (
                "station plan --config station.yaml -o plan.yaml  # from where the arm stands",
                "station plan --config station.yaml --check plan.yaml",
            ),
        ),
        "capture": LazyCommand(
            "station.cli.session:capture_command",
            (
                "station capture --plan plan.yaml",
                "station capture --plan plan.yaml --headless --approve 0123456789ab",
            ),
        ),
        "status": LazyCommand(
            "station.cli.requests:status_command", ("station status", "station status --json")
        ),
        "post": LazyCommand(
            "station.cli.post:post_command",
            ("python tell_pose.py | station post", "station post --typed kuka-abc"),
            rare=True,
        ),
        "stop": LazyCommand("station.cli.requests:stop_command", ("station stop",)),
        "acknowledge": LazyCommand(
            "station.cli.requests:acknowledge_command", ("station acknowledge",), rare=True
        ),
        "pause": LazyCommand("station.cli.requests:pause_command", ("station pause",), rare=True),
        "resume": LazyCommand("station.cli.session:resume_command", ("station resume",), rare=True),
        "finish": LazyCommand("station.cli.requests:finish_command", ("station finish",), rare=True),
        "retake": LazyCommand(
            "station.cli.requests:retake_command", ("station retake 7  # then: station resume",), rare=True
        ),
        "skip": LazyCommand("station.cli.requests:skip_command", ("station skip 7",), rare=True),
        "drift-check": LazyCommand(
            "station.cli.session:drift_check_command",
            (
                "station drift-check",
                "station drift-check --plan plan.yaml --headless --approve 0123456789ab",
            ),
        ),
        "accept": LazyCommand(
            "station.cli.accept:accept_command",
            ("station accept  # at the arm, the pendant in the hand", "station accept --speed 0.25"),
            rare=True,
        ),
        "new": LazyCommand("station.cli.new:new_command", ("station new", "station new -o station.yaml")),
        "doctor": LazyCommand(
            "station.cli.requests:doctor_command",
            ("station doctor --example > station.yaml", "station doctor --config station.yaml"),
        ),
    },
    help="A calibration station for a robot cell. Alone: the operator's screen.",
    epilog="Exit codes: 0 good, 1 failed, 2 usage, 3 done with loss, 4 gate failed.",
)
