"""The sharpness stage of the calibration: contrast maximisation."""
