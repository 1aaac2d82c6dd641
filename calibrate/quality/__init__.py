"""Quality of calibrations: gates, drift check, touch test, movement. Nothing here writes a calibration."""
