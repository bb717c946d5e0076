"""Live operation: the serial link to the prism's controller, and streams of events."""
