"""Failures of single runs and measurements of a study: each is recorded with its error, and the rest goes on."""

import contextlib
import traceback
from collections.abc import Iterator
from pathlib import Path

from amiwarp.errors import AmiwarpError, printable, shortened

PACKAGE = Path(__file__).resolve().parent.parent
"""Folder of the package, relative to which the place of an error is stated."""


def failure_text(error: BaseException) -> str:
    """Return what an error says, and where it was raised, as one line of text.

    The place is the innermost function of amiwarp that the error passed. The class is stated too, if the error is not
    an :class:`AmiwarpError`.
    """
    message = str(error) if isinstance(error, AmiwarpError) else f"{type(error).__name__}: {error}"
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        file = Path(frame.filename).resolve()
        if file.is_relative_to(PACKAGE):
            place = f"{file.relative_to(PACKAGE).as_posix()}:{frame.lineno}"
            message += f" (in {frame.name}, {place})"
            break
    return shortened(printable(" ".join(message.split())))


@contextlib.contextmanager
def noted(failed: dict[str, str], name: str) -> Iterator[None]:
    """Note an error that one measurement of a study raises in ``failed``, by its name, and go on after the block.

    Ctrl-C and other signals still end the run.
    """
    try:
        yield
    except Exception as error:
        failed[name] = failure_text(error)
