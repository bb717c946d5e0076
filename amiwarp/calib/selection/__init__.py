"""Selection of the model, and of the parameters that a recording determines."""
