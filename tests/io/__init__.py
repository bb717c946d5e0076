"""Tests of ``amiwarp/io/``."""
