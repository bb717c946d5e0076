"""Tests of the controller's firmware, in ``firmware/``."""
