"""Tests of ``amiwarp/learning/``."""
