"""All commands of `station`: where each one lives, and examples."""

from __future__ import annotations

from recordings.cli.lazy import LazyCommand, LazyGroup

STATION = LazyGroup(
    {
        "tui": LazyCommand(
            "station.cli.daemon:tui_command",
            "Open the operator screen; start a daemon if none runs.",
            ("station tui",),
        ),
        "demo": LazyCommand(
            "station.cli.demo:demo_command",
            "Run the whole job on a simulated cell: no hardware needed.",
            ("station demo", "station demo --seed 3 --mount eye-to-hand --noise mid --out trial"),
        ),
        "serve": LazyCommand(
            "station.cli.serve:serve_command",
            "Run the daemon that owns a real, simulated or replayed cell.",
            (
                "station serve --config station.yaml  # then, in another terminal: station",
                "station serve --config station.yaml --rehearse  # the same with no hardware",
                "station serve --simulate --mount eye-to-hand --noise mid",
                "station serve --replay session.mcap",
            ),
        ),
        "plan": LazyCommand(
            "station.cli.plan:plan_command",
            "Make a pose plan, or check one. Nothing moves.",
            (
                "station plan --config station.yaml -o plan.yaml  # from where the arm stands",
                "station plan --config station.yaml --check plan.yaml",
            ),
        ),
        "capture": LazyCommand(
            "station.cli.session:capture_command",
            "Capture the poses of a plan. Ctrl-C stops the arm.",
            (
                "station capture --plan plan.yaml",
                "station capture --plan plan.yaml --headless --approve 0123456789ab",
            ),
        ),
        "status": LazyCommand(
            "station.cli.requests:status_command",
            "Show what the station is doing.",
            ("station status", "station status --json"),
        ),
        "post": LazyCommand(
            "station.cli.post:post_command",
            "Post the pose of an arm that a person moves (robot.driver: posted).",
            ("python tell_pose.py | station post", "station post --typed kuka-abc"),
            rare=True,
        ),
        "stop": LazyCommand(
            "station.cli.requests:stop_command",
            "Stop the arm now (STOP).",
            ("station stop", "station stop --json"),
        ),
        "acknowledge": LazyCommand(
            "station.cli.requests:acknowledge_command",
            "Leave `stopped` or `fault` after looking at the cell. Nothing moves.",
            ("station acknowledge",),
            rare=True,
        ),
        "pause": LazyCommand(
            "station.cli.requests:pause_command",
            "Pause after the pose under way.",
            ("station pause",),
            rare=True,
        ),
        "resume": LazyCommand(
            "station.cli.session:resume_command",
            "Continue a paused or interrupted session. Ctrl-C stops the arm.",
            ("station resume",),
            rare=True,
        ),
        "finish": LazyCommand(
            "station.cli.requests:finish_command",
            "Finish the recording with the poses captured so far.",
            ("station finish",),
            rare=True,
        ),
        "retake": LazyCommand(
            "station.cli.requests:retake_command",
            "Mark a pose to be captured again by the next run.",
            ("station retake 7  # then: station resume",),
            rare=True,
        ),
        "skip": LazyCommand(
            "station.cli.requests:skip_command",
            "Leave a pose out, in later runs of the plan too.",
            ("station skip 7",),
            rare=True,
        ),
        "quit": LazyCommand(
            "station.cli.requests:quit_command",
            "End the station that you started by hand, such as by `station`.",
            ("station quit",),
            rare=True,
        ),
        "drift-check": LazyCommand(
            "station.cli.session:drift_check_command",
            "Check by a few new poses that the calibration holds.",
            (
                "station drift-check",
                "station drift-check --plan plan.yaml --headless --approve 0123456789ab",
            ),
        ),
        "accept": LazyCommand(
            "station.cli.accept:accept_command",
            "Test how the arm stops, in four ways: the watchdog is among them.",
            ("station accept  # at the arm, the pendant in the hand", "station accept --speed 0.25"),
            rare=True,
        ),
        "new": LazyCommand(
            "station.cli.new:new_command",
            "Set up a cell in a wizard that only reads.",
            ("station new", "station new -o station.yaml"),
        ),
        "doctor": LazyCommand(
            "station.cli.requests:doctor_command",
            "Check what a capture needs; say how to mend what is missing.",
            ("station doctor --example > station.yaml", "station doctor --config station.yaml"),
        ),
    },
    help="A calibration station for a robot cell. Alone: the operator's screen.",
    epilog="Exit codes: 0 good, 1 failed, 2 usage, 3 done with loss, 4 gate failed.",
    files={
        "~/.config/calibration-station/station.yaml": "Your cell, which `station` serves.",
        "/etc/station/station.yaml": "The computer's cell: that of the service, and of `station` where you "
        "have none of your own.",
        "/etc/station/station.example.yaml": "A configuration to start from, as `station doctor --example` "
        "prints it.",
        "/etc/station/station.env": "The service's environment.",
        "~/.local/state/calibration-station/": "State folder: sessions, installed calibrations, and "
        "daemon.log of a daemon that `station` started.",
        "/var/lib/station/": "State folder of the service.",
        "$XDG_RUNTIME_DIR/station-control.sock": "Control socket of a daemon that you started.",
        "/run/station/control.sock": "Control socket of the service. Where it exists it is the default.",
    },
    environment={
        "STATION_CONFIG": "Configuration to serve, in place of yours and of the computer's.",
        "STATE_DIRECTORY": "State folder, as systemd tells it; `--root` names another.",
        "RUNTIME_DIRECTORY": "Folder of the sockets, as systemd tells it; `--socket` names another.",
        "XDG_CONFIG_HOME, XDG_STATE_HOME, XDG_RUNTIME_DIR": "In place of ~/.config, of ~/.local/state, and "
        "folder of the sockets.",
        "TEXTUAL_THEME": "Theme of the screen: station-dark, station-light, terminal.",
        "NO_COLOR": "No colours; every state has a sign or a word all the same.",
    },
)
