"""Benchmarks of speed and accuracy, measured in the same runs: ``python -m benchmarks.NAME``."""
