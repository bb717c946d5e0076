"""Tests of ``amiwarp/sensors/``."""
