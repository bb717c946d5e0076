"""Warp kernels of the simulator, which no other room launches. Private."""
