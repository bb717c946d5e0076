"""Calibration of a camera's lens from a printed board that stands still behind the turning prism."""
