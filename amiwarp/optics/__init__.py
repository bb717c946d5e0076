"""The camera, the wedge prism, and the models of its refraction."""
