"""Speed and accuracy, measured together: run with ``python -m benchmarks.NAME``."""
