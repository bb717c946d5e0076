"""Sharpness stage of the calibration: contrast maximisation."""
