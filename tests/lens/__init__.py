"""Tests of ``amiwarp/lens/``."""
