"""Tests of ``amiwarp/brightness/``."""
