"""Figures and point clouds."""
