"""Gates, drift check, touch test and sweep. Nothing here writes a calibration."""
