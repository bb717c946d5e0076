"""Rigs: several cameras in one simulated world, on one body and one clock."""
