"""Worlds: three-dimensional scenes that a simulated camera moves through."""
