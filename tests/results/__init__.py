"""Tests of ``amiwarp/results/``."""
