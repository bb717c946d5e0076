"""Data sets in bulk: thousands of simulated recordings from a specification, with a manifest."""
