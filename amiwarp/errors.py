"""The one exception that bad input raises: its text names what was given, what was expected and the remedy."""

import unicodedata


class AmiwarpError(ValueError):
    """Bad input: a file, field or value that cannot be used. The message is one line for the user."""

    def __init__(self, message: str) -> None:
        """Keep the message without what a terminal would obey: it may quote a damaged file, or a forged one."""
        super().__init__("".join(map(_printable, message)))


def _printable(character: str) -> str:
    shown = character.isprintable() or unicodedata.category(character) == "Zs"
    return character if shown else "\N{REPLACEMENT CHARACTER}"
