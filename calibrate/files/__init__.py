"""Calibration file, installed versions, exports and texts for people. Public names are in `calibrate`."""
