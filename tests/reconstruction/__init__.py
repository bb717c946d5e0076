"""Tests of ``amiwarp/reconstruction/``."""
