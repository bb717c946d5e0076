"""The camera, the prism, and the models of its refraction."""
