"""Tests of ``amiwarp/studies/``."""
