"""Live work: the link to the prism's controller, and streams of events."""
