"""Tests of the rig's printable parts, bill and wires, in ``rig/``."""
