"""Live streams of events: packets, sources, sinks, sessions and the adaptive prism speed."""
