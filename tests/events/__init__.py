"""Tests of ``amiwarp/events/``."""
