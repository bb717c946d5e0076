"""Calibration: find the prism's parameters in the recording itself."""
