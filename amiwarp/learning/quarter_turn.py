"""Input of amiwarp's own network: events of a quarter turn, summed by how the prism moves the view."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents, find_indices, time_span
from amiwarp.events.encoder import Encoder
from amiwarp.imaging.tensors import polarity_histogram
from amiwarp.imaging.windows import Windows
from amiwarp.optics.models.base import Model

BINS = 6
INPUTS = 8
"""Equal parts of the quarter turn in which events are counted, and sums of these counts."""
LEAST_TURNS = 0.2
MOST_TURNS = 0.3
"""Turns of the first angle in a window that amiwarp's own network takes."""


def quarter_turn_sums(
    events: DeviceEvents,
    width: int,
    height: int,
    *,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
) -> Any:
    """Return the inputs of amiwarp's own network: a PyTorch tensor of shape (INPUTS, height, width).

    Raises :class:`AmiwarpError` without an optic, or if it does not turn by about a quarter in the window.
    """
    first, last = time_span(events) if len(events) else (0, 0)
    if t_start is None:
        t_start = first
    if t_end is None:
        t_end = last
    one_window = Windows(
        start=np.array([0], np.int64),
        stop=np.array([len(events)], np.int64),
        t_start=np.array([t_start], np.int64),
        t_end=np.array([t_end], np.int64),
    )
    return sums_of_windows(events, width, height, one_window, model, encoder)[0]


def sums_of_windows(
    events: DeviceEvents,
    width: int,
    height: int,
    windows: Windows,
    model: Model | None,
    encoder: Encoder | None,
) -> Any:
    """Return the inputs of amiwarp's own network for windows, in order of time: shape (n, INPUTS, height, width)."""
    import torch

    if model is None or encoder is None:
        raise AmiwarpError("amiwarp's own network compensates events: give model and encoder")
    if not len(events):
        device = torch.from_dlpack(events.t).device
        return torch.zeros(len(windows), INPUTS, height, width, device=device)

    # Times at which the parts of each window begin and end, shape (windows, BINS + 1)
    lengths = windows.t_end - windows.t_start
    ends = windows.t_start[:, None] + np.arange(BINS + 1) * lengths[:, None] // BINS
    _check_quarter_turns(encoder, ends)

    # Events of each part
    edges = ends + (np.arange(BINS + 1) == BINS)  # the last event may be at the end
    index = find_indices(events, edges.ravel()).reshape(ends.shape)
    index = np.clip(index, windows.start[:, None], windows.stop[:, None])
    parts = Windows(
        start=index[:, :-1].ravel(),
        stop=index[:, 1:].ravel(),
        t_start=ends[:, :-1].ravel(),
        t_end=ends[:, 1:].ravel(),
    )
    histograms = polarity_histogram(
        events, width, height, windows=parts, model=model, encoder=encoder, device=events.device
    )
    counts = torch.from_dlpack(histograms).reshape(len(windows), BINS, 2, height, width)
    return sums_of_parts(counts, chords_of(model, encoder, ends))


def _check_quarter_turns(encoder: Encoder, ends: NDArray[np.int64]) -> None:
    """Raise :class:`AmiwarpError` unless the optic turns by about a quarter in each window.

    ``ends``: times at which parts of the windows begin and end [us], shape (windows, n).
    """
    first = ends[:, 0]
    last = ends[:, -1]
    begin = encoder.angle_at(first)
    end = encoder.angle_at(last)
    turns = np.abs(end - begin) / math.tau
    wrong = (turns < LEAST_TURNS) | (turns > MOST_TURNS)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise AmiwarpError(
            f"the optic turns by {turns[k]:.2g} of a turn in the window of {last[k] - first[k]} us; amiwarp's own "
            "network takes a quarter turn: cut the events by windows(events, encoder=encoder, turns=0.25)"
        )


def chords_of(model: Model, encoder: Encoder, times: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return how far the middle of the compensated view moves between successive times [px].

    Times have the shape (..., n), chords (..., n - 1, 2).
    """
    camera = model.camera
    middle = np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
    middles = np.repeat(middle, times.size, axis=0)
    places = model.compensate_points(middles, encoder.angles_at(times.ravel()))
    path = np.asarray(places).reshape(*times.shape, 2)
    return np.diff(path, axis=-2).astype(np.float32)


def sums_of_parts(counts: Any, chords: NDArray[np.float32]) -> Any:
    """Return sums over the counts of the parts of a quarter turn, shape (n, INPUTS, height, width).

    ``counts``: tensor of OFF and ON events in each part, shape (n, BINS, 2, height, width). ``chords``: how far the
    view moves in each part [px], shape (n, BINS, 2), or (BINS, 2) for all.

    Where the view moves along a chord, ON minus OFF events add up to the gradient times the chord, in units of the
    threshold. So the first two sums are the least-squares gradient of all parts. The next two are its change over
    time, and the last four the number of events per pixel of the path, how it depends on the direction of the chord,
    and its change.
    """
    import torch

    late = np.linspace(-1.0, 1.0, chords.shape[-2])  # from the first to the last part

    # Sums of ON minus OFF events: the gradient by least squares, and its change
    gradient = np.linalg.pinv(chords)
    signed = np.concatenate([gradient, gradient * late], axis=-2)

    # Sums of ON plus OFF events. Edges of a direction fire alike on chords to both sides: hence twice the angle.
    twice = 2.0 * np.arctan2(chords[..., 1], chords[..., 0])
    ones = np.ones_like(twice)
    path_length = np.hypot(chords[..., 0], chords[..., 1]).sum(-1)[..., None, None]
    unsigned = np.stack([ones, np.cos(twice), np.sin(twice), late * ones], axis=-2) / path_length

    # Weights of OFF and ON events in each part, shape (n, INPUTS, BINS, 2), or without n
    signed_weights = signed[..., None] * [-1.0, 1.0]
    unsigned_weights = unsigned[..., None] * [1.0, 1.0]
    weights = np.concatenate([signed_weights, unsigned_weights], axis=-3)
    given = torch.tensor(weights.astype(np.float32), device=counts.device)
    rule = "cbp,nbphw->nchw" if given.ndim == 3 else "ncbp,nbphw->nchw"
    return torch.einsum(rule, given, counts)
