"""The simulator: recordings with ground truth from pictures and video."""
