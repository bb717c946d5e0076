"""Charts of speed against error: compensation and calibration in many settings, measured on one recording."""
