"""Photometric stage of the calibration: one brightness map must explain the events."""
