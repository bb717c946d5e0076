"""Live streams of events: their packets, where they come from and where they go."""
