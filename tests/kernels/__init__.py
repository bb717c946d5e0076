"""Tests of ``amiwarp/kernels/``."""
