"""The optical models, a file for each kind."""
