"""Figures, point clouds, and the palette that they share."""
