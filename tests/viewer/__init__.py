"""Tests of ``amiwarp/viewer/``."""
