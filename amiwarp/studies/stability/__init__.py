"""Stability study (atlas of failures): recordings under ever harder conditions, calibrated by several methods."""
