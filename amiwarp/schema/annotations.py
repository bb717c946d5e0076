"""Types that annotations name, also those that a module imports for type checkers only."""

import builtins
import collections.abc
import sys
import types
import typing
from typing import Any

import numpy as np


def annotated_type(function: Any, name: str) -> Any:
    """Return the type of a function's parameter; Any if it has no annotation, or one of a library that is not loaded.

    In an annotation, ``ArrayLike`` counts as Any: it stands for whatever NumPy takes.
    """
    annotation = function.__annotations__.get(name, Any)

    def holder() -> None:
        """Stand in for the function, whose other annotations would load what nobody needs yet."""

    holder.__annotations__ = {name: annotation}
    names = function.__globals__
    try:
        return typing.get_type_hints(holder, names, _LaterNames(names))[name]
    except AttributeError:  # of a library that is imported where it is used, as in pyvista.PolyData
        return Any


class _LaterNames(dict[str, Any]):
    """Names in annotations that are not among a module's names, because it imports them for type checkers only."""

    def __init__(self, module: dict[str, Any]) -> None:
        super().__init__(ArrayLike=Any)
        self._module = module

    def __contains__(self, name: object) -> bool:
        if name == "ArrayLike":
            return True
        # debuggers look for names such as __tracebackhide__ among the names of any code
        is_known = (
            str(name).startswith("__") or name in self._module or hasattr(builtins, str(name))
        )
        return not is_known

    def __missing__(self, name: str) -> Any:
        if name not in self:
            raise KeyError(name)  # the module's own
        for place in (collections.abc, typing, np.typing):
            if hasattr(place, name):
                return getattr(place, name)
        return getattr(sys.modules["amiwarp"], name, Any)


def parts_of(kind: Any) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    is_union = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return typing.get_args(kind) if is_union else (kind,)


def leaves(kind: Any) -> frozenset[Any]:
    """Return the plain types, and the generic ones without their parameters, of which a type is made up."""
    origin = typing.get_origin(kind)
    if origin in (typing.Literal, np.ndarray, collections.abc.Callable):
        return frozenset((origin,))
    if hasattr(origin, "__value__"):  # a named type, as NDArray is from NumPy 2.5 on
        return leaves(origin.__value__)
    found = {inner for part in typing.get_args(kind) for inner in leaves(part)} - {Ellipsis}
    if origin is None:
        found.add(kind)
    elif origin not in (typing.Union, types.UnionType):
        found.add(origin)
    return frozenset(found)
