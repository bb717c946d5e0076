"""Warp structs, device functions and kernels. Private: users call the modules of the rooms above."""
