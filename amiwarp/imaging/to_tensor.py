"""Transform of events to a tensor, called as the transforms of other libraries are."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.validation import check_names, shown


class ToTensor:
    """Transform of events to a tensor, which calls one of the representations with fixed options.

    It is called with events, as the transforms of tonic are, or with a recording and its labels, as
    :class:`RecordedDataset` does. It can be pickled, for the worker processes of a ``DataLoader``.

    Parameters
    ----------
    representation : callable
        Function such as :func:`voxel_grid`.
    **options : object
        Arguments of the function by name. ``width`` and ``height`` may be left out for recordings, which also have the
        ``encoder`` that a ``model`` or the function needs. ``windows`` may also be a function that is called with the
        events, such as ``functools.partial(amiwarp.windows, count=10_000)``.

    Raises
    ------
    AmiwarpError
        If the function has no parameter of a given name, or if a call lacks an option that the function needs.

    Examples
    --------
    >>> import numpy as np
    >>> to_grid = amiwarp.ToTensor(amiwarp.voxel_grid, width=4, height=3, bins=5)
    >>> rows = [(0, 1, 2, 1), (10, 3, 0, 0)]
    >>> events = np.array(rows, dtype=[("t", "i8"), ("x", "i2"), ("y", "i2"), ("p", "i1")])
    >>> to_grid(events).shape
    (5, 3, 4)
    """

    def __init__(self, representation: Callable[..., Any], **options: Any) -> None:
        if not callable(representation):
            raise AmiwarpError(
                f"representation is {shown(representation)}; give a function, such as voxel_grid"
            )
        self.representation = representation
        self.options = options
        parameters = inspect.signature(representation).parameters
        if not parameters:
            raise AmiwarpError(
                f"representation is {shown(representation)}, which takes no events; give a function, such as voxel_grid"
            )
        kinds = {parameter.kind for parameter in parameters.values()}
        self._known = None if inspect.Parameter.VAR_KEYWORD in kinds else {*parameters}
        self._needed = self._check(options)

    def _check(self, options: dict[str, Any]) -> tuple[str, ...]:
        """Return the names that the function needs besides the events. Raises :class:`AmiwarpError` for others."""
        _, *known = inspect.signature(self.representation).parameters.values()
        needed = []
        takes_any = False
        for parameter in known:
            if parameter.kind is parameter.VAR_KEYWORD:
                takes_any = True
            elif (
                parameter.kind is not parameter.VAR_POSITIONAL
                and parameter.default is parameter.empty
            ):
                needed.append(parameter.name)
        if not takes_any:
            check_names(options, [parameter.name for parameter in known], "option ")
        return tuple(needed)

    def __call__(self, events: Any, labels: Any = None, **more: Any) -> Any:
        """Return the tensor of events, or the tensor of a recording's events and the labels. ``more``: options."""
        options = self.options | more
        if more:
            self._check(more)
        if isinstance(events, Recording):
            source = events.events
            width, height = source.size
            of_recording = {"width": width, "height": height}
            if self._known is not None:
                for name in of_recording.keys() - self._known:
                    del of_recording[name]
            options = of_recording | options
            if options.get("model") is not None or "encoder" in self._needed:
                options.setdefault("encoder", events.encoder)
            events = source.slice(0, len(source))
        elif isinstance(events, np.ndarray) and events.dtype.names is not None:
            events = Events.from_structured(events)
        missing = [name for name in self._needed if name not in options]
        if missing:
            raise AmiwarpError(
                f"ToTensor has no {' and no '.join(missing)}; give the options by name, or a recording"
            )
        if callable(options.get("windows")):
            options["windows"] = options["windows"](events)
        tensor = self.representation(events, **options)
        return tensor if labels is None else (tensor, labels)

    def __repr__(self) -> str:
        options = "".join(f", {name}={value!r}" for name, value in self.options.items())
        return f"ToTensor({getattr(self.representation, '__name__', self.representation)}{options})"
