"""Tests of ``amiwarp/simulation/``."""
