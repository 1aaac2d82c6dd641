"""Notice in production pictures of one fixed tag or small board that camera, tag or arm moved.

    monitor.MovementMonitor     takes pictures one after the other, yields `MovementEvent`s: the way in
    pictures            a picture as a deviation of the tag's pose, and what each unknown would do to it
    comparisons         the two tests: a posture against its own history; any postures against a common fit
    evidence            likelihood ratios: did something move, and what

Nothing here reads a file. `calibrate.files.loader.watch` is another thing: it tells programs of installs.
"""
