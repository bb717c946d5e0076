"""The link to the controller of the prism's motor and encoder."""
