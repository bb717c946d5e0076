"""Reconstruction of log-intensity pictures from events."""
