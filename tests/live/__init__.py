"""Tests of ``amiwarp/live/``."""
