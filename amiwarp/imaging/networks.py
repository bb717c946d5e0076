"""Networks that make pictures or optical flow of events: amiwarp's own, and those that users bring as files."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.events.device_events import DeviceEvents, device_for, find_indices, first_beyond, time_span, wait
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.tensors import ToTensor, Windows, on_device, polarity_histogram, voxel_grid
from amiwarp.io.files import input_path
from amiwarp.io.formats import check_ending
from amiwarp.optics.models import Model
from amiwarp.validation import guarded, instance, shown, whole

ENDINGS = (".pt", ".pth", ".ts", ".onnx")
"""File suffixes of networks: TorchScript has the first three."""
LARGEST_MULTIPLE = 1 << 12
"""Largest number whose multiples the sizes of a network's input can be."""
LARGEST_BYTES = 1 << 32
"""Largest states or output that an ONNX file may declare [bytes]: 20 times the states of E2VID at 1280 x 720 px."""


@guarded
class Network:
    """Network from a TorchScript or ONNX file, which is called with events: for pictures, optical flow or other images.

    The defaults are those of E2VID [1]_. An instance keeps the states of a recurrent network from call to call.

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
        ending = check_ending(file, "networks are read", ENDINGS, "export the network to TorchScript or ONNX")
        input_path(file)
        self._file = _OnnxFile(file, self._device) if ending == ".onnx" else _TorchFile(file, self._device)
        self._first = None if states is None else [_as_array(state, self._device, "a state") for state in states]
        if self._first is not None and len(self._first) != self._file.extra:
            raise AmiwarpError(f"{file}: takes {self._file.extra} states, not {len(self._first)}; give one for each")
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
            Events of the window, raw or compensated, sorted by time; those on a device on that of the network.
        width, height : int
            Size of the image [px].
        t_start, t_end : int, optional
            First and last time of the window [us]. By default, those of the first and last event.
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
            Recording with the events. Those of :class:`DeviceMemoryEvents` stay on their device.
        windows : Windows
            Windows of the recording's events, in order of time.
        model : Model, optional
            Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
        encoder : Encoder, optional
            Encoder that covers the events. Requires ``model``.

        Returns
        -------
        iterator of ndarray or warp.array
            The result of each window, as that of a call.

        Raises
        ------
        AmiwarpError
            As for a call, or if the windows reach beyond the events.
        """
        last = int(windows.stop.max(initial=0))
        if last > len(recording.events):
            raise AmiwarpError(f"windows reach to event {last} of {len(recording.events)}; cut the recording's events")
        return self._iterate(recording, windows, {"model": model, "encoder": encoder})

    def reset(self) -> None:
        """Forget the states of earlier calls: the next window is the first one of a sequence."""
        self._states = None

    def _iterate(self, recording: Recording, windows: Windows, optic: dict[str, Any]) -> Iterator[Any]:
        states = None
        for events, some in _in_lots(recording, windows, 1):
            options = {"t_start": int(some.t_start[0]), "t_end": int(some.t_end[0]), **optic}
            out, states = self._run(events, *recording.events.size, states, options)
            yield out

    def _run(self, events: Any, width: int, height: int, states: Any, options: dict[str, Any]) -> tuple[Any, Any]:
        """Return the result for a window and the states after it. ``states``: those before it, None for the first."""
        known = {name: value for name, value in options.items() if value is not None}
        found = self._input(self._on_own_device(events), width=width, height=height, **known)
        grid = _as_array(found, self._device, "the input function's result")
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
        rows, columns = (-(-size // self._multiple) * self._multiple for size in (height, width))
        top, left = (rows - height + 1) // 2, (columns - width + 1) // 2  # as E2VID pads
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
            raise AmiwarpError(f"{self._file.path}: fails for input {padded.shape}: {_cause(error)}; {hint}") from error
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

    def _iterate(self, recording: Recording, windows: Windows, optic: dict[str, Any]) -> Iterator[Any]:
        size = recording.events.size
        for events, some in _in_lots(recording, windows, MOST_AT_ONCE):
            sums = sums_of_windows(self._on_own_device(events), *size, some, optic["model"], optic["encoder"])
            out, _ = self._run_grids(_as_array(sums, self._device, "the sums"), None)
            pictures = out if isinstance(events, DeviceEvents) else out.numpy()
            yield from (pictures[k] for k in range(len(some)))


def _in_lots(recording: Recording, windows: Windows, most: int) -> Iterator[tuple[Any, Windows]]:
    """Yield the events of at most ``most`` windows at a time, and these windows of them.

    Windows that follow one another are read together; others come one by one.
    """
    first = 0
    while first < len(windows):
        last = first + 1
        while last < min(first + most, len(windows)) and windows.start[last] == windows.stop[last - 1]:
            last += 1
        some = windows[first:last]
        start, stop = int(some.start[0]), int(some.stop[-1])
        yield recording.events[start:stop], Windows(some.start - start, some.stop - start, some.t_start, some.t_end)
        first = last


# amiwarp's own network.

OWN, OWN_MULTIPLE = Path(__file__).with_name("quarter_turn.pt"), 32
"""File of amiwarp's own network, and the number whose multiples its sizes are [px]."""
BINS, INPUTS = 6, 8
"""Equal parts of the quarter turn in which events are counted, and sums of these counts."""
MOST_AT_ONCE = 8
"""Most windows whose pictures are made at the same time, which takes less time per picture."""
LEAST_TURNS, MOST_TURNS = 0.2, 0.3
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
    times = (first if t_start is None else t_start), (last if t_end is None else t_end)
    one = Windows(*(np.array([value], np.int64) for value in (0, len(events), *times)))
    return sums_of_windows(events, width, height, one, model, encoder)[0]


def sums_of_windows(
    events: DeviceEvents, width: int, height: int, windows: Windows, model: Model | None, encoder: Encoder | None
) -> Any:
    """Return the inputs of amiwarp's own network for windows, in order of time: shape (n, INPUTS, height, width)."""
    import torch

    if model is None or encoder is None:
        raise AmiwarpError("amiwarp's own network compensates events: give model and encoder")
    if not len(events):
        return torch.zeros(len(windows), INPUTS, height, width, device=torch.from_dlpack(events.t).device)
    lengths = windows.t_end - windows.t_start
    ends = windows.t_start[:, None] + np.arange(BINS + 1) * lengths[:, None] // BINS
    begin, end = encoder.angle_at(ends[:, [0, -1]].ravel()).reshape(-1, 2).T
    turns = np.abs(end - begin) / math.tau
    wrong = (turns < LEAST_TURNS) | (turns > MOST_TURNS)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise AmiwarpError(
            f"the optic turns by {turns[k]:.2g} of a turn in the window of {lengths[k]} us; amiwarp's own network "
            "takes a quarter turn: cut the events by windows(events, encoder=encoder, turns=0.25)"
        )
    edges = ends + (np.arange(BINS + 1) == BINS)  # the last event may be at the end
    index = find_indices(events, edges.ravel()).reshape(ends.shape)
    index = np.clip(index, windows.start[:, None], windows.stop[:, None])
    parts = Windows(*(part.ravel() for part in (index[:, :-1], index[:, 1:], ends[:, :-1], ends[:, 1:])))
    found = polarity_histogram(events, width, height, windows=parts, model=model, encoder=encoder, device=events.device)
    counts = torch.from_dlpack(found).reshape(len(windows), BINS, 2, height, width)
    return sums_of_parts(counts, chords_of(model, encoder, ends))


def chords_of(model: Model, encoder: Encoder, times: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return how far the middle of the compensated view moves between successive times [px].

    Times have the shape (..., n), chords (..., n - 1, 2).
    """
    camera = model.camera
    middle = np.array([[0.5 * (camera.width - 1), 0.5 * (camera.height - 1)]])
    path = model.compensate_points(np.repeat(middle, times.size, axis=0), encoder.angles_at(times.ravel()))
    return np.diff(np.asarray(path).reshape(*times.shape, 2), axis=-2).astype(np.float32)


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

    late, twice = np.linspace(-1.0, 1.0, chords.shape[-2]), 2.0 * np.arctan2(chords[..., 1], chords[..., 0])
    towards = np.linalg.pinv(chords)
    signed = np.concatenate([towards, towards * late], axis=-2)
    length = np.hypot(chords[..., 0], chords[..., 1]).sum(-1)[..., None, None]
    ones = np.ones_like(twice)
    unsigned = np.stack([ones, np.cos(twice), np.sin(twice), late * ones], axis=-2) / length
    weights = np.concatenate([signed[..., None] * [-1.0, 1.0], unsigned[..., None] * [1.0, 1.0]], axis=-3)
    given = torch.tensor(weights.astype(np.float32), device=counts.device)
    return torch.einsum("cbp,nbphw->nchw" if given.ndim == 3 else "ncbp,nbphw->nchw", given, counts)


def _as_array(values: Any, device: Any, what: str) -> wp.array:
    """Return an array of any library as a Warp array on the device, without a copy if it is there and has no gaps."""
    try:
        if isinstance(values, wp.array) or (hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray)):
            found = values if isinstance(values, wp.array) else wp.from_dlpack(values)
            return found.to(device).contiguous()
        numbers = np.ascontiguousarray(values)
        return wp.array(numbers, dtype=wp.dtype_from_numpy(numbers.dtype), device=device)
    except Exception as error:  # libraries raise many kinds of errors
        raise AmiwarpError(f"{what} cannot be read as an array: {_cause(error)}; give an array of numbers") from error


def _cause(error: Exception) -> str:
    """Return the line of a library's message that says the most: the last one."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip().rstrip(".;")


class _TorchFile:
    """TorchScript file, run by PyTorch."""

    dtype, output = wp.float32, ""

    def __init__(self, path: Path, device: Any) -> None:
        torch = optional_module("torch", "torch", f"{path}: a TorchScript file needs PyTorch")
        self.path, self._torch = path, torch
        if device.is_cuda and not torch.cuda.is_available():
            raise AmiwarpError(f"{path}: PyTorch has no CUDA here; install its CUDA version, or give device='cpu'")
        try:
            with warnings.catch_warnings():  # PyTorch recommends other formats, which it cannot read on all versions
                warnings.simplefilter("ignore", DeprecationWarning)
                self._module = torch.jit.load(path, map_location=wp.device_to_torch(device)).eval()
        except Exception as error:  # RuntimeError, ValueError and others
            remedy = "write it by torch.jit.script(network).save(path); weights alone are no network"
            raise AmiwarpError(f"{path}: not a TorchScript file: {str(error).partition('.')[0]}; {remedy}") from error
        arguments = self._module.forward.schema.arguments[2:]  # without self and the input
        self.extra = len(arguments)
        self._needed = sum(not argument.has_default_value() for argument in arguments)

    def start(self, first: list[wp.array] | None) -> tuple[Any, ...]:
        """Return the states before the first window."""
        if first is None:
            return (None,) * self._needed
        return tuple(self._torch.from_dlpack(wp.clone(state)) for state in first)

    def run(self, grid: wp.array, states: tuple[Any, ...]) -> tuple[wp.array, tuple[Any, ...]]:
        """Return the first output and the states after a window."""
        with self._torch.no_grad():
            found = self._module(self._torch.from_dlpack(grid), *states)
        outputs = found if isinstance(found, tuple | list) else (found,)
        instance(outputs[0] if outputs else None, self._torch.Tensor, f"{self.path}: the first output")
        return wp.from_dlpack(outputs[0].contiguous()), tuple(outputs[1 : 1 + self.extra])


TYPES = {"tensor(float)": wp.float32, "tensor(float16)": wp.float16, "tensor(double)": wp.float64}
"""Types of inputs and outputs, by their names in onnxruntime."""


class _OnnxFile:
    """ONNX file, run by onnxruntime."""

    def __init__(self, path: Path, device: Any) -> None:
        onnxruntime = optional_module("onnxruntime", "onnx", f"{path}: an ONNX file needs onnxruntime")
        self.path, self._device = path, device
        self._place = ("cuda", device.ordinal) if device.is_cuda else ("cpu", 0)
        provider = "CUDAExecutionProvider" if device.is_cuda else "CPUExecutionProvider"
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # errors are raised
        try:
            chosen = [(provider, {"device_id": device.ordinal} if device.is_cuda else {})]
            available = provider in onnxruntime.get_available_providers()
            session = onnxruntime.InferenceSession(path, options, chosen if available else ["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises many kinds of errors
            raise AmiwarpError(f"{path}: not an ONNX file that can be read: {_cause(error)}; export it anew") from error
        if provider not in session.get_providers():
            raise AmiwarpError(f"{path}: onnxruntime has no CUDA here; install onnxruntime-gpu, or give device='cpu'")
        self._session, self._inputs = session, session.get_inputs()
        self._outputs = [output.name for output in session.get_outputs()]
        self.output = f" '{self._outputs[0]}'"
        self.extra = len(self._inputs) - 1
        if len(self._outputs) <= self.extra:
            raise AmiwarpError(
                f"{path}: has {self.extra} inputs after the first and {len(self._outputs) - 1} outputs after the first"
                "; export the network with one output for each state"
            )
        self.dtype = self._type(self._inputs[0].type)
        self._check_sizes("states", self._inputs[1:])
        for output in session.get_outputs():
            self._check_sizes(f"output {output.name}", [output])

    def _check_sizes(self, what: str, declared: Sequence[Any]) -> None:
        """Raise :class:`AmiwarpError` if inputs or outputs take too much memory. Sizes without a number count as 1."""
        size = 0
        for one in declared:
            item = wp.types.type_size_in_bytes(TYPES[one.type]) if one.type in TYPES else 1
            size += item * math.prod(length for length in one.shape if isinstance(length, int))
        if size > LARGEST_BYTES:
            shapes = ", ".join(shown(one.shape) for one in declared[:4])
            raise AmiwarpError(
                f"{self.path}: its {what} of shape {shapes} take {size / 2**30:.4g} GiB; expected at most "
                f"{LARGEST_BYTES >> 30} GiB; the file is damaged, or export the network for smaller images"
            )

    def _type(self, name: str) -> Any:
        if name not in TYPES:
            raise AmiwarpError(f"{self.path}: has a {name}; expected {', '.join(TYPES)}; export the network so")
        return TYPES[name]

    def start(self, first: list[wp.array] | None) -> list[Any]:
        """Return the states before the first window."""
        if first is not None:
            return first
        for wanted in self._inputs[1:]:
            if not all(isinstance(size, int) and size > 0 for size in wanted.shape):
                raise AmiwarpError(
                    f"{self.path}: {wanted.name} has the shape {wanted.shape}; give its first value in states"
                )
        return [wp.zeros(one.shape, dtype=self._type(one.type), device=self._device) for one in self._inputs[1:]]

    def run(self, grid: wp.array, states: list[Any]) -> tuple[wp.array, list[Any]]:
        """Return the first output and the states after a window."""
        wanted, given = list(self._inputs[0].shape), list(grid.shape)
        known = [k for k, size in enumerate(wanted) if isinstance(size, int)]  # others have names
        if len(wanted) != 4 or [wanted[k] for k in known] != [given[k] for k in known]:
            remedy = "multiple" if wanted[:2] == given[:2] else "the bins of the input"
            raise AmiwarpError(f"{self.path}: takes inputs of shape {wanted}, not {given}; change {remedy}")
        binding = self._session.io_binding()
        for wanted, value in zip(self._inputs, [grid, *states], strict=True):
            if isinstance(value, wp.array):
                kind = wp.dtype_to_numpy(value.dtype)
                binding.bind_input(wanted.name, *self._place, kind, value.shape, value.ptr)
            else:
                binding.bind_ortvalue_input(wanted.name, value)
        for name in self._outputs:
            binding.bind_output(name, *self._place)
        self._session.run_with_iobinding(binding)
        binding.synchronize_outputs()
        out, *others = binding.get_outputs()
        image = wp.array(
            ptr=out.data_ptr(), shape=tuple(out.shape()), dtype=self._type(out.data_type()), device=self._device
        )
        image.owner = out  # which keeps the memory
        return image, others[: self.extra]
