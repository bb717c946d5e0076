"""Private: Warp structs, device functions and kernels. Users call the modules above, never these."""
