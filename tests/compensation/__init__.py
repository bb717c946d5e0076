"""Tests of ``amiwarp/compensation/``."""
