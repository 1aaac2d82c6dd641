"""Detect from production images of one fixed tag or small board that camera, tag or arm moved.

    monitor.MovementMonitor     entry point: takes images one after the other, yields `MovementEvent`s
    pictures            an image as the deviation of the tag's pose, and its derivatives by each unknown
    comparisons         the two tests: a posture against its own history; any postures against a common fit
    evidence            likelihood ratios: did something move, and what

Not to be confused with `calibrate.files.loader.watch`, which tells programs of newly installed calibrations.
"""
