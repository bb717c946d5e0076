"""Serial link to the controller that drives the prism's motor and reads its encoder."""
