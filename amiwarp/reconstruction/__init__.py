"""Image reconstruction from events."""
