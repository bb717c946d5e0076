"""Public names of types that are no classes to call: what a call of them says."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

from amiwarp.errors import AmiwarpError

Target = TypeVar("Target", bound=Callable[..., Any])
"""Any class."""


def not_called(instead: str) -> Callable[[Target], Target]:
    """Decorate a protocol or base class, so that a call of it says what to do ``instead``. Derived classes are free."""

    def decorate(target: Target) -> Target:
        base: Any = target

        def init(self: Any, *args: Any, **options: Any) -> None:
            if type(self) is base:
                raise AmiwarpError(
                    f"{base.__name__} is a type for annotations and for own classes; {instead}"
                )
            super(base, self).__init__(*args, **options)

        # help() shows a call without arguments, as before.
        init.__signature__ = inspect.signature(lambda self: None)  # type: ignore[attr-defined]
        base.__init__ = init
        return target

    return decorate


class NamedType:
    """Public name of a type that is no class, for annotations and ``isinstance``; a call says what to call instead.

    The name may also be joined with other types by ``|``.
    """

    def __init__(self, name: str, value: Any) -> None:
        self.__name__ = name
        self.__value__ = value

        # Python checks no parameters: of ``Callable[[str], None]`` it checks only that a value can be called.
        is_function = typing.get_origin(value) is Callable
        self._checked: Any = Callable if is_function else value

    def __call__(self, *_: object, **__: object) -> NoReturn:
        parts = typing.get_args(self.__value__)
        if self._checked is Callable:
            takes = ", ".join(part.__name__ for part in parts[0])
            instead = f"give a function of ({takes})"
        else:
            *others, last = [part.__name__ for part in parts]
            instead = f"use {', '.join(others)} or {last}"
        raise AmiwarpError(f"{self.__name__} is a type for annotations; {instead}")

    def __instancecheck__(self, value: object) -> bool:
        return isinstance(value, self._checked)

    def __subclasscheck__(self, kind: type) -> bool:
        return issubclass(kind, self._checked)

    def __or__(self, other: Any) -> Any:
        return self.__value__ | other

    def __ror__(self, other: Any) -> Any:
        return other | self.__value__

    def __repr__(self) -> str:
        return f"amiwarp.{self.__name__}"
