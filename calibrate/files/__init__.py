"""Calibration file, installed versions, exports and words for people. The door is `calibrate` itself."""
