"""Tests of ``amiwarp/optics/``."""
