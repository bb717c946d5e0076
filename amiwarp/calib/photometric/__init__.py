"""The photometric stage of the calibration."""
