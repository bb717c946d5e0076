"""Tests of the repository as a whole: pages, structure, releases, public values."""
