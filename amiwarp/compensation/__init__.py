"""Motion compensation of recordings and streams: every event goes where it would be without the prism."""
