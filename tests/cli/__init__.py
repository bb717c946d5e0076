"""Tests of ``amiwarp/cli/``."""
