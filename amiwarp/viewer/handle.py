"""The inspector driven from Python: below a notebook cell, or in a window."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
import socket
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from amiwarp.choices import Axis, Colour, View
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.optics.models.registry import alternatives
from amiwarp.results.calibration import Calibration
from amiwarp.results.depth_map import DepthMap
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice, instance, one_of, real, vector, whole
from amiwarp.viewer import first_phase, view_state
from amiwarp.viewer.actions import Actions
from amiwarp.viewer.address import LONGEST_TIME_US, MOST_EVERY, RATE_LIMITS
from amiwarp.viewer.display import check_display
from amiwarp.viewer.drawn_truth import colours_on_offer
from amiwarp.viewer.images import ImageKind
from amiwarp.viewer.inspector import WINDOW_POINTS, Inspector
from amiwarp.viewer.knobs import Source, foreign_names
from amiwarp.viewer.look import PICTURE_PX, Look
from amiwarp.viewer.screenshot import draw_picture
from amiwarp.viewer.sliders import LIMITS, UNITS
from amiwarp.viewer.view_state import ViewState

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

    from amiwarp.viewer.panel import Panel
    from amiwarp.viewer.window import Window

TIME = ("start_us", "length_us")
"""Names of the values of the time window [us]. The start is on the events' clock."""
SELECTION = ("region", "polarity", "hide_hot", "noise_us", "refractory_us", "most_per_s", "every")
"""Names of the values that select events."""
STYLE = ("image", "decay_us", "difference", "same_scale", "colour", "axis", "view", "overlaid")
"""Names of the values of how the events are shown."""


def parameter_names(inspector: Inspector, model: str) -> list[str]:
    """Return the names of the parameters that a model of this recording has."""
    absent = {"rpm" if inspector.has_encoder else "clock_offset"} | foreign_names(model)
    return [name for name in LIMITS if name not in absent]


def values_of(inspector: Inspector, state: ViewState) -> dict[str, Any]:
    """Return the values of a state by name, in the units of :meth:`InspectorHandle.set`."""
    knobs = state.knobs
    known = {name: knobs.value(name) for name in parameter_names(inspector, knobs.model)}
    return {
        "model": knobs.model,
        **{name: value for name, value in known.items() if value is not None},
        "start_us": inspector.recording.events.t_first + state.start_us,
        "length_us": state.length_us,
        **{name: getattr(state.selection, name) for name in SELECTION},
        **{name: getattr(state, name) for name in STYLE},
    }


def with_values(inspector: Inspector, state: ViewState, values: dict[str, Any]) -> ViewState:
    """Return a state with other values, in the units of :meth:`InspectorHandle.set`.

    Raises :class:`AmiwarpError` for an unknown name, or a value that this recording cannot have.
    """
    model = one_of(
        values.get("model", state.knobs.model), [*alternatives(state.knobs.model)], "model"
    )
    parameters = parameter_names(inspector, model)
    known = ["model", *parameters, *TIME, *SELECTION, *STYLE]
    for name in values:
        if name not in known:
            raise AmiwarpError(
                f"{inspector.recording.name}: {name!r} is unknown; choose among {', '.join(known)}"
            )
    knobs = {}
    for name in parameters:
        if name in values:
            low, high = (end * UNITS[name] for end in LIMITS[name])
            knobs[name] = real(values[name], name, low, high)
    events = inspector.recording.events
    selection: dict[str, Any] = {}
    other: dict[str, Any] = {}
    if "start_us" in values:
        clock = " us: from the first event of the recording to its last one"
        start_us = whole(values["start_us"], "start_us", events.t_first, events.t_last, clock)
        other["start_us"] = start_us - events.t_first
    if "length_us" in values:
        other["length_us"] = whole(
            values["length_us"], "length_us", 1, events.t_last - events.t_first + 1
        )
    if "region" in values:
        selection["region"] = _region(values["region"], events.size)
    if "polarity" in values:
        given = values["polarity"]
        selection["polarity"] = None if given is None else whole(given, "polarity", 0, 1)
    if "hide_hot" in values:
        selection["hide_hot"] = instance(values["hide_hot"], bool, "hide_hot")
    if "noise_us" in values:
        given = values["noise_us"]
        selection["noise_us"] = (
            None if given is None else whole(given, "noise_us", 1, LONGEST_TIME_US)
        )
    if "refractory_us" in values:
        selection["refractory_us"] = whole(
            values["refractory_us"], "refractory_us", 0, LONGEST_TIME_US
        )
    if "most_per_s" in values:
        selection["most_per_s"] = real(values["most_per_s"], "most_per_s", *RATE_LIMITS)
    if "every" in values:
        selection["every"] = whole(values["every"], "every", 1, MOST_EVERY)
    if "decay_us" in values:
        other["decay_us"] = whole(values["decay_us"], "decay_us", 1, LONGEST_TIME_US)
    for name, kind in (("image", ImageKind), ("axis", Axis), ("view", View)):
        if name in values:
            other[name] = choice(kind, values[name], name)
    if "colour" in values:
        offered = [colour.value for colour in colours_on_offer(inspector.recording.truth)]
        other["colour"] = Colour(one_of(values["colour"], offered, "colour"))
    for name in ("overlaid", "difference", "same_scale"):
        if name in values:
            other[name] = instance(values[name], bool, name)
    now = replace(state.knobs.with_values(knobs), model=model)
    sources = []
    for name, source in state.sources:
        if name not in ("camera", "prism") and now.value(name) != state.knobs.value(name):
            source = Source.HAND
        sources.append((name, source))
    selected = replace(state.selection, **selection)
    return replace(state, knobs=now, sources=tuple(sources), selection=selected, **other)


def _region(value: object, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    """Return a region of the image [px]; None for the whole one. Raises :class:`AmiwarpError` for any other value."""
    if value is None:
        return None
    width, height = size
    left, top, right, bottom = vector(value, 4, "region", partial(whole, low=0, high=max(size)))
    if not (left < right <= width and top < bottom <= height):
        raise AmiwarpError(
            f"region = {(left, top, right, bottom)} is no part of the image of {width}x{height} px; give left, top, "
            "right and bottom, right and bottom exclusive, or None for the whole image"
        )
    return (
        None if (left, top, right, bottom) == (0, 0, width, height) else (left, top, right, bottom)
    )


@guarded
class InspectorHandle:
    """The inspector that :func:`view` shows: its values can be read and set, and changes can be followed.

    Values have names: ``model``, the parameters of the optical model (``apex``, ``phase`` [rad], ``clock_offset`` [us]
    or, without an encoder, ``rpm`` [1/min], …), the time window ``start_us`` on the events' clock and ``length_us``
    [us], the selection ``region`` (left, top, right, bottom [px]; None for the whole image), ``polarity`` (1, 0 or
    None), ``hide_hot``, ``noise_us`` and ``refractory_us`` [us], ``most_per_s`` [events/s] and ``every``, and the style
    ``colour``, ``axis``, ``view``, ``overlaid``, ``image``, ``decay_us`` [us], ``difference`` and ``same_scale``.

    Parameters
    ----------
    inspector : Any
        What :func:`view` makes of the recording: values are set in it, and pictures made of it.

    Examples
    --------
    >>> inspector = amiwarp.view(amiwarp.open_recording("recording.h5"))  # doctest: +SKIP
    >>> inspector.set(apex=0.0349, phase=1.2)  # doctest: +SKIP
    >>> inspector.seek(1_200_000)  # doctest: +SKIP
    """

    def __init__(self, inspector: Any) -> None:  # users get a handle from view, and make none
        self._own: Inspector = inspector
        self._state: ViewState | None = None
        self._callbacks: list[Callable[[dict[str, Any]], object]] = []
        self._tabs: weakref.WeakSet[Panel] = weakref.WeakSet()
        self._window: Window | None = None
        self._drawing = (
            False  # whether the window handles its input, during which it cannot be asked to
        )
        self._serving: asyncio.Task[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._scheduled = 0  # changes that the tabs have not got yet

    @property
    def values(self) -> dict[str, Any]:
        """What is shown, by name. A change of this dictionary changes nothing; use :meth:`set`."""
        return values_of(self._own, self._known())

    def set(self, **values: object) -> None:
        """Set values by name, in the page and in the window, as if a user had done it: undo takes them back.

        Parameters
        ----------
        **values : object
            Values by name, as :attr:`values` has them; angles are in rad, times in us.

        Raises
        ------
        AmiwarpError
            For an unknown name, with the known ones, for a value that this recording cannot have, and for a window and
            a selection without events. Nothing is changed then.

        Examples
        --------
        >>> inspector.set(phase=1.2, colour="residual")  # doctest: +SKIP
        """
        before = self._known()
        state = with_values(self._own, before, values)
        view_state.apply_state(self._own, state)
        self._state = state
        if self._loop is not None:
            self._scheduled += 1
            self._loop.call_soon_threadsafe(self._change_tabs, dict(values))
        if self._window is not None:
            self._change(self._window, values)
            self._draw()
        self._call_back(before, state)

    def seek(self, t_us: int, length_us: int | None = None) -> None:
        """Move the time window.

        Parameters
        ----------
        t_us : int
            Its start, on the events' clock [us].
        length_us : int, optional
            Its length [us]. Default: as it is.

        Raises
        ------
        AmiwarpError
            If the start is outside of the recording, or the window holds no selected events.

        Examples
        --------
        >>> inspector.seek(recording.events.t_first + 100_000)  # doctest: +SKIP
        """
        self.set(start_us=t_us, **({} if length_us is None else {"length_us": length_us}))

    def on_change(self, callback: Callable[[dict[str, Any]], object]) -> Callable[[], None]:
        """Call a function after each change, by the user or by :meth:`set`, with the values that have changed.

        An error of the function is logged and shown as a message; the inspector goes on.

        Parameters
        ----------
        callback : callable
            Function that gets a dictionary with names and new values, in the units of :attr:`values`.

        Returns
        -------
        callable
            Function that ends this.

        Examples
        --------
        >>> stop = inspector.on_change(lambda changed: print(changed))  # doctest: +SKIP
        >>> stop()  # doctest: +SKIP
        """
        self._callbacks.append(callback)

        def stop() -> None:
            self._callbacks[:] = [known for known in self._callbacks if known is not callback]

        return stop

    def picture(self, size: tuple[int, int] = PICTURE_PX, *, dark: bool = False) -> PillowImage:
        """Return a picture of both event clouds as they are shown, which a notebook keeps after its kernel has ended.

        Parameters
        ----------
        size : tuple of int
            Width and height [px].
        dark : bool
            Whether the background is dark.

        Returns
        -------
        PIL.Image.Image
            Picture with legend and caption.

        Raises
        ------
        AmiwarpError
            If VTK cannot draw on this machine, or the size is not 100 to 8000 px.

        Examples
        --------
        >>> inspector.picture()  # doctest: +SKIP
        """
        from PIL import Image

        width, height = vector(size, 2, "size", partial(whole, low=100, high=8000))
        state = self._known()
        view_state.apply_state(self._own, state)
        look = Look(state.colour, state.axis, dark=dark, overlaid=state.overlaid)
        return Image.fromarray(
            draw_picture(self._own, state.view, look, (width, height), state.against)
        )

    def run(self) -> None:
        """Follow the user until the window is closed. A page in a notebook needs no call: this returns at once.

        Examples
        --------
        >>> inspector.run()  # doctest: +SKIP
        """
        if self._window is None:
            return
        window = self._window
        self._drawing = True
        try:
            window.run()
        finally:
            self._window = None
            self._drawing = False

    def close(self) -> None:
        """Close the window, or stop serving the page. Values can be set and pictures made from then on, too.

        Examples
        --------
        >>> inspector.close()  # doctest: +SKIP
        """
        if self._serving is not None:
            self._serving.cancel()
        window = self._window
        if window is not None:
            window.close()
            if not self._drawing:
                self._window = None
                window.scene.close()

    def _ipython_display_(self) -> None:
        """Show nothing more than the page, which is already shown."""

    def _known(self) -> ViewState:
        """Return the last known state; before anybody looks, the one with which page and window start."""
        if self._state is None:
            inspector = self._own
            window = inspector.window or inspector.first_window()
            inspector.open(*window)
            if math.isfinite(inspector.turn_us):
                first_phase.estimate_phase(inspector)
                inspector.open(
                    *window, replace(inspector.selection, region=inspector.suggest_region())
                )
            self._state = view_state.current_state(inspector)
        return self._state

    def _attach_tab(self, panel: Panel) -> None:
        """Follow a tab that opens, and let it show what is known already."""
        self._tabs.add(panel)
        if self._state is not None:
            state = self._state
            panel.travel(lambda _: state)
        panel.listener = self._hear

    def _change_tabs(self, values: dict[str, Any]) -> None:
        self._scheduled -= 1
        for panel in list(self._tabs):
            if not panel.inspector.closed:
                self._change(panel, values)

    def _change(self, actions: Actions, values: dict[str, Any]) -> None:
        """Let a tab or a window change these values of its own state."""
        actions.travel(lambda _: with_values(actions.inspector, actions.state_now(), values))

    def _draw(self) -> None:
        """Let the window handle its input so far and draw, unless it is doing so."""
        if self._window is not None and not self._drawing:
            self._drawing = True
            try:
                self._window.run_once()
            finally:
                self._drawing = False

    def _hear(self, state: ViewState) -> None:
        """Take what a tab or the window shows now."""
        if self._scheduled:  # it will be told another state at once
            return
        before = self._state
        self._state = state
        if before is not None:
            self._call_back(before, state)

    def _call_back(self, before: ViewState, now: ViewState) -> None:
        """Tell the callbacks which values have changed."""
        old = values_of(self._own, before)
        new = values_of(self._own, now)
        changed = {
            name: value for name, value in new.items() if name not in old or old[name] != value
        }
        if not changed:
            return
        for callback in list(self._callbacks):
            try:
                callback(dict(changed))
            except Exception as error:
                name = getattr(callback, "__name__", type(callback).__name__)
                logging.getLogger(__name__).exception("the callback %s failed", name)
                text = f"the callback {name} failed: {type(error).__name__}: {error}"
                for tab in self._tabs:
                    tab.say(text)
                if self._window is not None:
                    self._window.say(text)


@guarded
def view(
    recording: Recording,
    calibration: Calibration | None = None,
    *,
    beside: Recording | None = None,
    depth: DepthMap | None = None,
    device: Any = "cpu",
    height: int = 700,
) -> InspectorHandle:
    """Show the inspector below a notebook cell; without a notebook, in a window.

    In a notebook, the page is in the cell's output before this returns, so that tools that run notebooks, such as
    nbclient and papermill, keep it; Warp's messages are switched off, so that the cell shows only the page. A window
    handles its input in :meth:`InspectorHandle.run`, which follows the user until it is closed, and draws at once what
    a program sets.

    Parameters
    ----------
    recording : Recording
        Events to show. Encoder, camera and prism may be missing.
    calibration : Calibration or None
        Parameters of the prism at the start. Without it, the page starts with the nominal prism.
    beside : Recording or None
        Another recording with as many pixels, which the left cloud shows as recorded, at the same time after its first
        event.
    depth : DepthMap or None
        Depth map of a recording behind a plate. It is shown, and the events are compensated at its depths.
    device : str or warp.Device
        Device that compensates the events.
    height : int
        Height of the page in the notebook [px].

    Returns
    -------
    InspectorHandle
        Handle to read and set what is shown. The page is served until the kernel ends or ``close`` is called.

    Raises
    ------
    AmiwarpError
        If a recording holds no events, the calibration, the recording beside or the depth map belongs to a camera of
        another size, the depth map is given for another optic than a plate, there is neither a notebook nor a
        display, or there is a notebook and the libraries of the page are missing (``pip install 'amiwarp[page]'``).

    Examples
    --------
    >>> inspector = amiwarp.view(amiwarp.open_recording("recording.h5"))  # doctest: +SKIP
    """

    def make_inspector(device: Any = device, most_points: int | None = None) -> Inspector:
        made = Inspector(recording, calibration, device=device, most_points=most_points)
        if beside is not None:
            made.put_beside(beside)
        if depth is not None:
            made.use_depths(depth)
        return made

    try:
        loop = asyncio.get_running_loop()
        from IPython.display import IFrame, display
    except (ImportError, RuntimeError):  # no IPython, or no running loop
        check_display(
            f"{recording.name}: view shows a recording in a notebook or a window; or run: amiwarp view FILE "
            "--web"
        )
        handle = InspectorHandle(make_inspector("cpu"))
        _open_window(handle, make_inspector(device, WINDOW_POINTS))
        return handle

    from amiwarp.kernels.quiet_start import start_quietly
    from amiwarp.viewer.host_names import address
    from amiwarp.viewer.serve import check_libraries
    from amiwarp.viewer.serve_panel import LOCAL_HOST, serve_tabs

    check_libraries()
    start_quietly()
    # The handle's own inspector, whose errors the cell shows before the page is served, is on the CPU: only one thread
    # may call a GPU, and that is a tab's.
    handle = InspectorHandle(make_inspector("cpu"))
    # The port is opened here, because programs that run notebooks keep only what a cell shows before it ends, and the
    # server starts after that. A browser that is faster waits until the server answers.
    listening = socket.create_server((LOCAL_HOST, 0))
    token = secrets.token_urlsafe(16)
    serving = loop.create_task(
        serve_tabs(
            make_inspector,
            host=LOCAL_HOST,
            token=token,
            listening=listening,
            opened=handle._attach_tab,
        )
    )
    # Also if it ends before the server takes the socket
    serving.add_done_callback(lambda _: listening.close())
    display(IFrame(address(LOCAL_HOST, listening.getsockname()[1], token), "100%", height))
    handle._serving = serving
    handle._loop = loop
    return handle


def _open_window(
    handle: InspectorHandle, inspector: Inspector, *, off_screen: bool = False
) -> None:
    """Open a window that a handle drives. ``off_screen``: draw without a display, for tests."""
    from amiwarp.viewer.window import Window

    window = Window(inspector, off_screen=off_screen)
    handle._window = window
    handle._state = window.state_now()
    view_state.apply_state(handle._own, handle._state)
    window.listener = handle._hear
