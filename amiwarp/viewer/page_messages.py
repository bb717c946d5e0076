"""Filter for messages from a page: known calls whose arguments have the expected type and size. Drops all others."""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

MOST_BYTES = 64 * 1024
"""Largest accepted size of a message from a page [bytes]. The page's own messages have a few hundred bytes, and it
never splits them into parts."""
HEADER_BYTES = 12
"""Size of the header of each message part [bytes]: message number, start of the part and length of the message, 32 bits
each."""
MOST_CHARACTERS = 2000
MOST_ID = 120
"""Largest accepted length of a text that the page gives to a function of the server, such as the state in its address,
and of the number of a call."""
LARGEST = 1e12
"""Largest accepted number in a message; in ms it is 30 years."""
Check = Callable[[Any], bool]
"""Function that returns whether a value is allowed."""


def number(low: float = -LARGEST, high: float = LARGEST) -> Check:
    """Return a check that accepts numbers from ``low`` to ``high``; it rejects NaN and booleans."""
    # Comparisons with NaN are false
    return lambda value: type(value) in (int, float) and low <= value <= high


def one_of(*known: Any) -> Check:
    """Return a check that accepts the ``known`` values, types included."""
    return lambda value: any(type(value) is type(choice) and value == choice for choice in known)


flag = one_of(True, False)
ARGUMENTS: Mapping[type, Check] = {
    str: lambda value: isinstance(value, str) and len(value) <= MOST_CHARACTERS,
    float: number(),
    int: lambda value: type(value) is int and abs(value) <= LARGEST,
    bool: flag,
}
"""Checks of the arguments of functions that the page calls, by their annotation."""


class MessageFilter:
    """Filter for the messages that one page sends."""

    def __init__(self, server: Any, settable: Mapping[str, Check]) -> None:
        """Allow the messages of a page on ``server``.

        ``settable`` maps each state variable that the page may set to the check of its values.
        """
        self._server = server
        self._settable = settable
        self._warned = False

    def passes(self, message: bytes) -> bool:
        """Return whether the message is allowed. Log the first message that is not."""
        import msgpack  # type: ignore[import-untyped]

        try:
            start, length = (int.from_bytes(message[k : k + 4], "little") for k in (4, 8))
            whole = (start, length) == (0, len(message) - HEADER_BYTES)
            allowed = whole and self._is_call(msgpack.unpackb(message[HEADER_BYTES:]))
        except Exception:  # invalid bytes make the decoder raise errors of many types
            allowed = False
        if not allowed and not self._warned:
            self._warned = True
            logging.getLogger(__name__).warning(
                "dropped a message of %d bytes that no page sends", len(message)
            )
        return allowed

    def _is_call(self, call: Any) -> bool:
        """Return whether a decoded message is a call that a page makes, and nothing more."""
        match call:
            case {"id": str(number), "method": method, "args": list(args), **more} if (
                len(number) <= MOST_ID
            ):
                plain = more.get("kwargs", {}) == {} and isinstance(more.get("wslink", ""), str)
                return plain and more.keys() <= {"wslink", "kwargs"} and self._takes(method, args)
        return False

    def _takes(self, method: Any, args: list[Any]) -> bool:
        """Return whether a page may call a method with these arguments."""
        match method, args:
            case "wslink.hello", [{"secret": str(), **more}]:
                return not more
            case "trame.state.get", []:
                return True
            case "trame.lifecycle.update", [event]:
                return event in ("client_connected", "client_exited", "client_unmounted")
            case "trame.error.client", [str(report)]:
                return len(report) <= 2 * MOST_CHARACTERS
            case "trame.state.update", [list(changes)]:
                return all(map(self._is_change, changes))
            case "trame.trigger", [str(name), list(given), {**more}]:
                return not more and self._is_trigger(name, given)
        return False

    def _is_change(self, change: Any) -> bool:
        """Return whether the page may give a state variable this value."""
        match change:
            case {"key": str(key), "value": value, **more} if key in self._settable and not more:
                return self._settable[key](value)
        return False

    def _is_trigger(self, name: str, given: list[Any]) -> bool:
        """Return whether a function that the page may call exists and takes arguments of these types."""
        called = self._server.controller.trigger_fn(name)
        if called is None:
            return False
        signature = inspect.signature(called, eval_str=True)
        arguments = signature.bind(
            *given
        ).arguments  # raises TypeError for another number of arguments
        return all(
            ARGUMENTS[signature.parameters[k].annotation](value) for k, value in arguments.items()
        )


def finite_number(given: str) -> float:
    """Return the typed text as a number, clipped to ±:data:`LARGEST`. Raises :class:`ValueError` for other text."""
    value = float(given or 0.0)
    if math.isnan(value):
        raise ValueError(given)
    return min(max(value, -LARGEST), LARGEST)
