"""Tests of ``amiwarp/calib/``."""
