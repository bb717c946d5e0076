"""Tests of ``amiwarp/plotting/``."""
