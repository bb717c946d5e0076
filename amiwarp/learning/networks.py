"""Networks that make pictures or optical flow of events: amiwarp's own, and those that users bring as files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_columns import first_beyond
from amiwarp.events.device_events import DeviceEvents, device_for, wait
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.tensors import voxel_grid
from amiwarp.imaging.to_tensor import ToTensor
from amiwarp.imaging.windows import Windows, on_device
from amiwarp.io.inputs import input_path
from amiwarp.io.output_formats import check_ending
from amiwarp.learning.network_files import OnnxFile, TorchFile, as_array, cause
from amiwarp.learning.quarter_turn import quarter_turn_sums, sums_of_windows
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded
from amiwarp.validation import whole

ENDINGS = (".pt", ".pth", ".ts", ".onnx")
"""File suffixes of networks: TorchScript has the first three."""
LARGEST_MULTIPLE = 1 << 12
"""Largest number whose multiples the sizes of a network's input can be."""
OWN = Path(__file__).with_name("quarter_turn.pt")
OWN_MULTIPLE = 32
"""File of amiwarp's own network, and the number whose multiples its sizes are [px]."""
MOST_AT_ONCE = 8
"""Most windows whose pictures are made at the same time, which takes less time per picture."""


@guarded
class Network:
    """Network from a TorchScript or ONNX file, which is called with events: for pictures, optical flow or other images.

    The defaults come from E2VID [1]_. An instance keeps the states of a recurrent network from call to call.

    Parameters
    ----------
    path : str or os.PathLike
        TorchScript file (``.pt``, ``.pth``, ``.ts``), which needs PyTorch, or ONNX file (``.onnx``), which needs
        onnxruntime.
    input : callable, optional
        Function that makes the network's input of one window, shape ``(channels, height, width)``. It is called as
        ``input(events, width=..., height=...)`` with :class:`DeviceEvents` on the network's device, and also with
        ``t_start``, ``t_end``, ``model`` and ``encoder`` if they are given. By default, it is
        ``ToTensor(voxel_grid, bins=5, normalize=True)``.
    multiple : int, default 8
        The input is padded by zeros to a height and a width that are multiples of this number [px], and the output is
        cropped. It is 2 to the power of the number of the network's encoders that halve the size.
    states : sequence of array, optional
        States before the first window, one for each input of the network after the first. By default, they are zero for
        ONNX, with the shapes in the file, and None for TorchScript.
    device : str or warp.Device, default "cpu"
        Device of the network.

    Raises
    ------
    AmiwarpError
        If the file cannot be read, the package that reads it is missing or cannot use the device, or the states do not
        fit.

    Notes
    -----
    The first input has the shape ``(1, channels, height, width)``. The first output is the result. If the network has
    more inputs, the outputs after the first are its states: they are the other inputs of the next window, in this
    order.

    References
    ----------
    .. [1] Rebecq et al., "High speed and high dynamic range video with an event camera", TPAMI 2021.

    Examples
    --------
    >>> import onnx.parser
    >>> text = '''<ir_version: 8, opset_import: ["": 18]>
    ... running_sum (float[1,2,2,3] counts, float[1,2,2,3] before) => (float[1,2,2,3] total, float[1,2,2,3] after) {
    ...   total = Add (counts, before)
    ...   after = Identity (total)
    ... }'''
    >>> onnx.save(onnx.parser.parse_model(text), "running_sum.onnx")
    >>> to_counts = amiwarp.ToTensor(amiwarp.polarity_histogram)
    >>> network = amiwarp.Network("running_sum.onnx", input=to_counts, multiple=1)
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> network(events, 3, 2).sum(), network(events, 3, 2).sum()
    (np.float32(3.0), np.float32(6.0))
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, 3, 2))
    >>> [float(total.sum()) for total in network.over(recording, amiwarp.windows(events, count=1))]
    [1.0, 2.0, 3.0]
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        input: Callable[..., Any] | None = None,
        *,
        multiple: int = 8,
        states: Sequence[object] | None = None,
        device: Any = "cpu",
    ) -> None:
        file = Path(path)
        self._input = ToTensor(voxel_grid, bins=5, normalize=True) if input is None else input
        self._multiple = whole(multiple, "multiple", 1, LARGEST_MULTIPLE, " px")
        self._device = wp.get_device(device)
        ending = check_ending(
            file, "networks are read", ENDINGS, "export the network to TorchScript or ONNX"
        )
        input_path(file)
        kind = OnnxFile if ending == ".onnx" else TorchFile
        self._file = kind(file, self._device)
        self._first = None
        if states is not None:
            self._first = [as_array(state, self._device, "a state") for state in states]
        if self._first is not None and len(self._first) != self._file.extra:
            raise AmiwarpError(
                f"{file}: takes {self._file.extra} states, not {len(self._first)}; give one for each"
            )
        self._states: Any = None

    @classmethod
    def quarter_turn(cls, device: Any = "cpu") -> Network:
        """Return amiwarp's own network, which makes pictures of compensated events. It needs PyTorch.

        It is called with the events of a quarter turn, their model and encoder, and returns log intensity in units of
        the contrast threshold, up to a constant, shape ``(1, height, width)``. It was trained on simulated events of
        flat worlds, half of them with moving bodies, for deflections of 1.5 to 6 px (``benchmarks/network.py``).

        Parameters
        ----------
        device : str or warp.Device, default "cpu"
            Device of the network.

        Returns
        -------
        Network
            The network.

        Raises
        ------
        AmiwarpError
            If PyTorch is missing or cannot use the device.

        Examples
        --------
        >>> import numpy as np
        >>> scene = np.random.default_rng(0).random((64, 64)).astype(np.float32)
        >>> camera, prism = amiwarp.Camera.from_fov(64, 48, 1.0), amiwarp.Prism(0.05)
        >>> recording = amiwarp.simulate(scene, camera, prism, duration_s=0.1)
        >>> optic = {"model": amiwarp.ExactModel(camera, prism), "encoder": recording.encoder}
        >>> turns = amiwarp.windows(recording.events[:], encoder=recording.encoder, turns=0.25)
        >>> network = amiwarp.Network.quarter_turn()
        >>> next(network.over(recording, turns, **optic)).shape
        (1, 48, 64)
        """
        return _QuarterTurn(OWN, input=quarter_turn_sums, multiple=OWN_MULTIPLE, device=device)

    def __call__(
        self,
        events: Events | DeviceEvents,
        width: int,
        height: int,
        *,
        t_start: int | None = None,
        t_end: int | None = None,
        model: Model | None = None,
        encoder: Encoder | None = None,
    ) -> NDArray[Any] | wp.array:
        """Return the network's result for the next window of events, and keep its states for the window after that.

        Parameters
        ----------
        events : Events or DeviceEvents
            Events of the window, raw or compensated, sorted by time; events on a device must be on the network's.
        width, height : int
            Size of the image [px].
        t_start, t_end : int, optional
            First and last time of the window [us]. By default, the times of the first and last event.
        model : Model, optional
            Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
        encoder : Encoder, optional
            Encoder that covers the events. Requires ``model``.

        Returns
        -------
        ndarray or warp.array
            The first output, shape ``(channels, height, width)``, such as a picture with one channel, or flow along x
            and y. A Warp array on the same device for :class:`DeviceEvents`.

        Raises
        ------
        AmiwarpError
            If the events are on another device, or the network does not fit its input, gives no such output, or gives
            NaN or infinity.
        """
        options = {"t_start": t_start, "t_end": t_end, "model": model, "encoder": encoder}
        out, self._states = self._run(events, width, height, self._states, options)
        return out

    def over(
        self,
        recording: Recording,
        windows: Windows,
        *,
        model: Model | None = None,
        encoder: Encoder | None = None,
    ) -> Iterator[NDArray[Any] | wp.array]:
        """Iterate over the network's results for windows of a recording, from the first states on.

        The events of one window at a time are read. The states of calls are neither used nor changed.

        Parameters
        ----------
        recording : Recording
            Recording with the events. Events of :class:`DeviceMemoryEvents` stay on their device.
        windows : Windows
            Windows of the recording's events, in order of time.
        model : Model, optional
            Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
        encoder : Encoder, optional
            Encoder that covers the events. Requires ``model``.

        Returns
        -------
        iterator of ndarray or warp.array
            The result of each window, as a call returns it.

        Raises
        ------
        AmiwarpError
            As for a call, or if the windows reach beyond the events.
        """
        last = int(windows.stop.max(initial=0))
        if last > len(recording.events):
            raise AmiwarpError(
                f"windows reach to event {last} of {len(recording.events)}; cut the recording's events"
            )
        return self._iterate(recording, windows, {"model": model, "encoder": encoder})

    def reset(self) -> None:
        """Forget the states of earlier calls: the next window is the first one of a sequence."""
        self._states = None

    def _iterate(
        self, recording: Recording, windows: Windows, optic: dict[str, Any]
    ) -> Iterator[Any]:
        states = None
        for events, some in _in_lots(recording, windows, 1):
            options = {"t_start": int(some.t_start[0]), "t_end": int(some.t_end[0]), **optic}
            out, states = self._run(events, *recording.events.size, states, options)
            yield out

    def _run(
        self, events: Any, width: int, height: int, states: Any, options: dict[str, Any]
    ) -> tuple[Any, Any]:
        """Return the result for a window and the states after it. ``states``: those before it, None for the first."""
        given = {name: value for name, value in options.items() if value is not None}
        values = self._input(self._on_own_device(events), width=width, height=height, **given)
        grid = as_array(values, self._device, "the input function's result")
        if grid.ndim != 3 or grid.shape[1:] != (height, width):
            raise AmiwarpError(
                f"the input function gives shape {grid.shape}; expected (channels, {height}, {width}), one window"
            )
        out, states = self._run_grids(grid.reshape((1, *grid.shape)), states)
        return out[0] if isinstance(events, DeviceEvents) else out[0].numpy(), states

    def _on_own_device(self, events: Any) -> DeviceEvents:
        """Return events on the network's device. Raises :class:`AmiwarpError` if they are on another one."""
        device_for(events, self._device if isinstance(events, DeviceEvents) else None)
        return on_device(events, self._device)

    def _run_grids(self, grids: wp.array, states: Any) -> tuple[wp.array, Any]:
        """Return the results for inputs of windows, shape (n, channels, height, width), and the states after them."""
        n, channels, height, width = grids.shape
        # Rounded up to whole multiples
        rows = -(-height // self._multiple) * self._multiple
        columns = -(-width // self._multiple) * self._multiple
        # As E2VID pads
        top = (rows - height + 1) // 2
        left = (columns - width + 1) // 2
        padded = wp.zeros((n, channels, rows, columns), dtype=self._file.dtype, device=self._device)
        wp.utils.array_cast(grids, padded[:, :, top : top + height, left : left + width])
        if states is None:
            states = self._file.start(self._first)
        wait(self._device)
        try:
            out, states = self._file.run(padded, states)
        except AmiwarpError:
            raise
        except Exception as error:  # both libraries raise many kinds of errors
            hint = (
                "check the bins and the type of the input, and multiple; give states=[...] if it takes no None at"
                " first, and call reset() before images of another size"
            )
            raise AmiwarpError(
                f"{self._file.path}: fails for input {padded.shape}: {cause(error)}; {hint}"
            ) from error
        if out.ndim != 4 or out.shape[0] != n or out.shape[2:] != (rows, columns):
            raise AmiwarpError(
                f"{self._file.path}: its first output has shape {out.shape}; expected "
                f"({n}, channels, {rows}, {columns}), the size of the input"
            )
        result = wp.clone(out[:, :, top : top + height, left : left + width])
        self._check_finite(result)
        wait(self._device)
        return result, states

    def _check_finite(self, result: wp.array) -> None:
        """Raise :class:`AmiwarpError` if the result of windows, (n, channels, height, width), has NaN or infinity."""
        if not wp.types.type_is_float(result.dtype):
            return
        values = result.flatten()
        if values.dtype is not wp.float32:
            values = wp.empty(result.size, dtype=float, device=self._device)
            wp.utils.array_cast(result.flatten(), values)
        place = first_beyond(values, float(np.finfo(np.float32).max))
        if place < result.size:
            value = float(values[place : place + 1].numpy()[0])
            _, channel, row, column = (int(k) for k in np.unravel_index(place, result.shape))
            raise AmiwarpError(
                f"{self._file.path}: its first output{self._file.output} holds {value:g} in channel {channel} at row "
                f"{row}, column {column}; expected finite numbers: check the network's weights, its input, and states; "
                "reset() forgets the states"
            )


class _QuarterTurn(Network):
    """amiwarp's own network, which makes the pictures of several windows at a time."""

    def _iterate(
        self, recording: Recording, windows: Windows, optic: dict[str, Any]
    ) -> Iterator[Any]:
        size = recording.events.size
        for events, some in _in_lots(recording, windows, MOST_AT_ONCE):
            sums = sums_of_windows(
                self._on_own_device(events), *size, some, optic["model"], optic["encoder"]
            )
            out, _ = self._run_grids(as_array(sums, self._device, "the sums"), None)
            pictures = out if isinstance(events, DeviceEvents) else out.numpy()
            yield from (pictures[k] for k in range(len(some)))


def _in_lots(recording: Recording, windows: Windows, most: int) -> Iterator[tuple[Any, Windows]]:
    """Yield the events of at most ``most`` windows at a time, and these windows of them.

    Windows that follow one another are read together; others come one by one.
    """
    first = 0
    while first < len(windows):
        last = first + 1
        while (
            last < min(first + most, len(windows)) and windows.start[last] == windows.stop[last - 1]
        ):
            last += 1
        some = windows[first:last]
        start = int(some.start[0])
        stop = int(some.stop[-1])
        yield (
            recording.events[start:stop],
            Windows(some.start - start, some.stop - start, some.t_start, some.t_end),
        )
        first = last
