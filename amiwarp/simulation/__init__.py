"""Simulator of event cameras behind a rotating prism: recordings with ground truth from pictures and video."""
