"""Filter for messages from a page: known calls whose arguments have the expected type and size. Drops all others."""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Callable, Mapping
from typing import Any

import msgpack  # type: ignore[import-untyped]

MOST_BYTES = 64 * 1024
"""Largest accepted size of a message from a page [bytes]. The page's own messages have a few hundred bytes, and it
never splits them into parts."""
HEADER_BYTES = 12
"""Size of the header of each message part [bytes]: message number, start of the part and length of the message, 32 bits
each."""
MOST_CHARACTERS = 2000
"""Largest accepted length of a text that the page gives to a function of the server, such as the state in its address.
"""
LARGEST = 1e12
"""Largest accepted number in a message; in ms it is 30 years."""

Check = Callable[[Any], bool]
"""Function that returns whether a value is allowed."""


def number(low: float = -LARGEST, high: float = LARGEST) -> Check:
    """Return a check that accepts numbers from ``low`` to ``high``; it rejects NaN and booleans."""

    def check(value: Any) -> bool:
        return type(value) in (int, float) and low <= value <= high  # comparisons with NaN are false

    return check


def text(most: int) -> Check:
    """Return a check that accepts strings of at most ``most`` characters."""
    return lambda value: isinstance(value, str) and len(value) <= most


def one_of(*known: Any) -> Check:
    """Return a check that accepts the ``known`` values, types included."""
    return lambda value: any(type(value) is type(each) and value == each for each in known)


def list_of(*checks: Check) -> Check:
    """Return a check that accepts lists with one item for each of ``checks``."""
    return lambda value: (
        isinstance(value, list)
        and len(value) == len(checks)
        and all(check(each) for check, each in zip(checks, value, strict=True))
    )


def record(required: Mapping[str, Check], optional: Mapping[str, Check] | None = None) -> Check:
    """Return a check that accepts dictionaries with all ``required`` keys, and no others except ``optional`` ones."""
    known = {**required, **(optional or {})}

    def check(value: Any) -> bool:
        return (
            isinstance(value, dict)
            and required.keys() <= value.keys() <= known.keys()
            and all(known[name](each) for name, each in value.items())
        )

    return check


def _integer(value: Any) -> bool:
    return type(value) is int and abs(value) <= LARGEST


flag = one_of(True, False)
ARGUMENTS: Mapping[str, Check] = {"str": text(MOST_CHARACTERS), "float": number(), "int": _integer}
"""Checks of the arguments of functions that the page calls, by their annotation."""


class MessageFilter:
    """Filter for the messages that one page sends."""

    def __init__(self, server: Any, settable: Mapping[str, Check]) -> None:
        """Allow the messages of a page on ``server``.

        ``settable`` maps each state variable that the page may set to the check of its values.
        """
        self._server, self._warned = server, False
        change = self._change(settable)
        self._calls: dict[str, Check] = {
            "wslink.hello": list_of(record({"secret": text(64)})),
            "trame.state.get": list_of(),
            "trame.lifecycle.update": list_of(one_of("client_connected", "client_exited", "client_unmounted")),
            "trame.error.client": list_of(text(4000)),
            "trame.state.update": list_of(lambda changes: isinstance(changes, list) and all(map(change, changes))),
            "trame.trigger": self._is_trigger,
        }

    def passes(self, message: bytes) -> bool:
        """Return whether the message is allowed. Log the first message that is not."""
        try:
            allowed = self._is_call(_unpacked(message))
        except Exception:  # invalid bytes make the decoder raise errors of many types
            allowed = False
        if not allowed and not self._warned:
            self._warned = True
            logging.getLogger(__name__).warning("dropped a message of %d bytes that no page sends", len(message))
        return allowed

    def _is_call(self, call: Any) -> bool:
        known = {"id": text(120), "method": text(60), "args": lambda args: isinstance(args, list)}
        more = {"wslink": text(10), "kwargs": one_of({})}
        return record(known, more)(call) and call["method"] in self._calls and self._calls[call["method"]](call["args"])

    def _is_trigger(self, args: list[Any]) -> bool:
        """Return whether a function that the page may call exists and takes arguments of these types."""
        if not list_of(text(60), lambda given: isinstance(given, list), one_of({}))(args):
            return False
        name, given, _ = args
        called = self._server.controller.trigger_fn(name)
        if called is None:
            return False
        signature = inspect.signature(called)
        arguments = signature.bind(*given).arguments  # raises TypeError for another number of arguments
        return all(ARGUMENTS[signature.parameters[k].annotation](value) for k, value in arguments.items())

    @staticmethod
    def _change(settable: Mapping[str, Check]) -> Check:
        shape = record({"key": text(60), "value": lambda _: True})
        return lambda change: shape(change) and change["key"] in settable and settable[change["key"]](change["value"])


def _unpacked(message: bytes) -> Any:
    """Decode a message in one part. Raises :class:`ValueError` for a message in several parts."""
    start, length = (int.from_bytes(message[k : k + 4], "little") for k in (4, 8))
    if (start, length) != (0, len(message) - HEADER_BYTES):
        raise ValueError("received a part of a message; expected the complete message")
    return msgpack.unpackb(message[HEADER_BYTES:])


def finite(given: str) -> float:
    """Return the typed text as a number, clipped to ±:data:`LARGEST`. Raises :class:`ValueError` for other text."""

    value = float(given or 0.0)
    if math.isnan(value):
        raise ValueError(given)
    return min(max(value, -LARGEST), LARGEST)
