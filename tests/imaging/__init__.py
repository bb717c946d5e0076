"""Tests of ``amiwarp/imaging/``."""
