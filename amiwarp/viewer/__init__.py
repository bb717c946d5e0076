"""The inspector: an interactive page that shows a recording's events and their motion compensation."""
