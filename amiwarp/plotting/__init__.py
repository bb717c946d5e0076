"""Figures, point clouds, and the colour palette that they share."""
