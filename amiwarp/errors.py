"""The one exception that bad input raises: its text names what was given, what was expected and the remedy."""


class AmiwarpError(ValueError):
    """Bad input: a file, field or value that cannot be used. The message is one line for the user."""
