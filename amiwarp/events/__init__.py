"""Events, recordings and the prism's encoder."""
