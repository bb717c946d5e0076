"""Motion compensation of recordings and streams."""
