"""Mechanics of a rig that turns a wedge prism in front of an event camera: parts, drawings and numbers."""
