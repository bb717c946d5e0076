"""Measures of the evaluations, as functions of arrays."""
