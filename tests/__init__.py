"""Tests of the installed package: ``pytest`` in the checkout."""
