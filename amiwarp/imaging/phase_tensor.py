"""Sums in phase as a tensor for networks."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.phase import BINS, phase_sums
from amiwarp.imaging.windows import Windows
from amiwarp.schema.calls import guarded


@guarded
def phase_tensor(
    events: Events | DeviceEvents,
    width: int,
    height: int,
    harmonics: int,
    *,
    encoder: Encoder,
    windows: Windows | None = None,
    turns: float | None = None,
    off_ratio: float | None = None,
    bins: int = BINS,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Return the sums of each pixel's events in phase with the optic, as channels.

    For a still scene, whole turns hold all that the pixel saw: the first sum is the gradient of the scene, turned by
    the optic's phase. Cut them by :func:`windows` with ``turns``.

    Parameters
    ----------
    events : Events or DeviceEvents
        Raw events, sorted by time.
    width, height : int
        Sensor size [px].
    harmonics : int
        Number of harmonics, 1 to 64 and less than half of ``bins``.
    encoder : Encoder
        Encoder that covers the events. Of two angles, the first one counts.
    windows : Windows, optional
        Windows of the events, of which each gives a tensor.
    turns : float, optional
        Number of turns that the events, or each of the windows, cover; by default as :func:`phase_sums` finds it.
    off_ratio : float, optional
        OFF threshold divided by the ON threshold. By default as in :func:`phase_sums`, for each window.
    bins : int, optional
        Number of bins of a turn.
    device : str or warp.Device, optional
        Device to compute on, by default the events' device or the CPU.

    Returns
    -------
    ndarray or warp.array
        Real and imaginary part of A_1, A_2, … [thresholds], float32, shape ``(2 * harmonics, height, width)``; with
        ``windows`` one more axis in front. A Warp array on the events' device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        As :func:`phase_sums`, or if the windows reach beyond the events.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([0, 0], [0, 0], [0, 500], [1, 0])
    >>> encoder = amiwarp.Encoder.constant_speed(60_000.0, 0, 1000)
    >>> amiwarp.phase_tensor(events, 4, 3, 2, encoder=encoder).shape
    (4, 3, 4)
    """
    parts: list[Events | DeviceEvents] = [events]
    if windows is not None:
        last = int(windows.stop.max(initial=0))
        if last > len(events):
            raise AmiwarpError(
                f"windows reach to event {last} of {len(events)}; cut the windows of these events"
            )
        pairs = zip(windows.start.tolist(), windows.stop.tolist(), strict=True)
        parts = [events[first:stop] for first, stop in pairs]
    found = []
    for part in parts:
        sums = phase_sums(
            part,
            encoder,
            width,
            height,
            turns=turns,
            off_ratio=off_ratio,
            harmonics=harmonics,
            bins=bins,
            device=device,
        )
        channels = np.stack([sums.values.real, sums.values.imag], axis=1)
        found.append(channels.reshape(2 * harmonics, height, width))
    tensor = np.empty((0, 2 * harmonics, height, width), np.float32)
    if found:
        tensor = np.stack(found) if windows is not None else found[0]
    if isinstance(events, DeviceEvents):
        return wp.array(tensor, dtype=float, device=events.device)
    return tensor
