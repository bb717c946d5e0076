"""Images of warped events by the circle model in other libraries, written as their users would write them.

The formula is x - r cos, y - r sin, with four bilinear votes. Before the timing starts, x, y and the angle within one
turn are in memory as uint16 and float32. PyTorch has little support for uint16, so it gets float32 only. The image has
a margin wider than any displacement, so no bounds checks are needed. These implementations serve only to compare their
speed and error with those of amiwarp.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.tasks import cpu_threads

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 1 << 16
"""Number of events per block of NumPy and PyTorch. The arrays of a block fit into a CPU's cache."""


class Missing(Exception):
    """Raised if a library is not installed, or does not run on this device. The row is then skipped with this text."""


@dataclass(frozen=True, slots=True, eq=False)
class PeerEvents:
    """Events in the form that users of other libraries have, and the circle by which to compensate them."""

    x: NDArray[np.uint16]
    """Column of each event on the sensor [px]."""
    y: NDArray[np.uint16]
    """Row of each event on the sensor [px]."""
    angle: NDArray[np.float32]
    """Direction of each displacement, within one turn [rad]."""
    radius: float
    """Radius of the circle on which events are displaced [px]."""
    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    margin: int
    """Margin around the image that contains all compensated events [px]: larger than the radius plus 1."""
    _kept: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image, including its margin."""
        return self.height + 2 * self.margin, self.width + 2 * self.margin

    def keep(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the result of ``make``, which is called only once per key."""
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]

    def places(self, which: slice) -> NDArray[np.float32]:
        """Return the compensated positions by the formula in float32 [px], shape ``(n, 2)``."""
        angle, radius = self.angle[which], np.float32(self.radius)
        xy = np.stack([self.x[which], self.y[which]], axis=1).astype(np.float32)
        return np.asarray(xy - radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@dataclass(frozen=True, slots=True)
class Peer:
    """Implementation with one library, with the events in memory."""

    run: Callable[[], Any]
    """Function that runs one pass, which is timed. On CUDA it may return before the device has finished."""
    with_margin: Callable[[], Any]
    """Function that returns the image of the latest pass, including the margin."""
    events: PeerEvents
    """Events that the implementation votes into the image."""

    def image(self) -> NDArray[np.floating[Any]]:
        """Return the image of the latest pass without the margin, shape ``(height, width)``."""
        m = self.events.margin
        return np.asarray(self.with_margin()).reshape(self.events.shape)[m:-m, m:-m]


def library(name: str) -> Any:
    """Import a library. Raises :class:`Missing` if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise Missing(f"{name} is not installed") from error


def with_numpy(events: PeerEvents, device: str, *, block: int | None = None) -> Peer:
    """Prepare NumPy: four calls of ``add.at`` (faster than ``bincount`` in NumPy 2) over whole arrays or blocks."""
    x, y, angle, radius, margin = (
        events.x,
        events.y,
        events.angle,
        np.float32(events.radius),
        np.float32(events.margin),
    )
    rows, columns = events.shape
    image = np.zeros(rows * columns, np.float32)

    def run() -> None:
        image[:] = 0.0
        for start in range(0, len(x), block or len(x)):
            part = slice(start, start + (block or len(x)))
            u = x[part] - radius * np.cos(angle[part]) + margin
            v = y[part] - radius * np.sin(angle[part]) + margin
            i, j = u.astype(np.intp), v.astype(np.intp)
            fx, fy = u - i.astype(np.float32), v - j.astype(np.float32)
            cell = j * columns + i
            np.add.at(image, cell, (1 - fx) * (1 - fy))
            np.add.at(image, cell + 1, fx * (1 - fy))
            np.add.at(image, cell + columns, (1 - fx) * fy)
            np.add.at(image, cell + columns + 1, fx * fy)

    return Peer(run, lambda: image, events)


@cache
def numba_kernels() -> tuple[Any, Any]:
    """Return two Numba kernels: sine and cosine per event, and a table of displacements.

    Each thread has its own image.
    """
    nb = library("numba")
    one = np.float32(1.0)

    def vote(image: Any, u: Any, v: Any) -> None:
        i, j = int(u), int(v)
        fx, fy = u - np.float32(i), v - np.float32(j)
        image[j, i] += (one - fx) * (one - fy)
        image[j, i + 1] += fx * (one - fy)
        image[j + 1, i] += (one - fx) * fy
        image[j + 1, i + 1] += fx * fy

    cast = nb.njit(fastmath=True, inline="always")(vote)

    def by_sine(
        x: Any, y: Any, angle: Any, radius: Any, margin: Any, images: Any, total: Any
    ) -> None:
        n, parts = len(x), len(images)
        for k in nb.prange(parts):
            images[k] = 0.0
            for e in range(n * k // parts, n * (k + 1) // parts):
                c, s = np.cos(angle[e]), np.sin(angle[e])
                cast(
                    images[k],
                    np.float32(x[e]) - radius * c + margin,
                    np.float32(y[e]) - radius * s + margin,
                )
        for row in nb.prange(total.shape[0]):
            total[row] = images[:, row].sum(axis=0)

    def by_table(x: Any, y: Any, turn: Any, dx: Any, dy: Any, images: Any, total: Any) -> None:
        n, parts = len(x), len(images)
        for k in nb.prange(parts):
            images[k] = 0.0
            for e in range(n * k // parts, n * (k + 1) // parts):
                cast(images[k], np.float32(x[e]) + dx[turn[e]], np.float32(y[e]) + dy[turn[e]])
        for row in nb.prange(total.shape[0]):
            total[row] = images[:, row].sum(axis=0)

    fast = nb.njit(parallel=True, fastmath=True)
    return fast(by_sine), fast(by_table)


def _numba_images(events: PeerEvents) -> tuple[Any, Any]:
    return np.zeros((cpu_threads(), *events.shape), np.float32), np.zeros(events.shape, np.float32)


def with_numba(events: PeerEvents, device: str) -> Peer:
    """Prepare Numba, parallel and with ``fastmath``."""
    kernel, _ = numba_kernels()
    images, total = _numba_images(events)
    sizes = np.float32(events.radius), np.float32(events.margin)
    inputs = (events.x, events.y, events.angle, *sizes, images, total)
    return Peer(lambda: kernel(*inputs), lambda: total, events)


def with_numba_table(events: PeerEvents, device: str) -> Peer:
    """Prepare Numba, with 16-bit angles as in amiwarp and a table of displacements."""
    _, kernel = numba_kernels()
    images, total = _numba_images(events)
    angle = np.arange(65536) * (2.0 * np.pi / 65536)
    turn = (
        np.rint(events.angle * np.float64(65536 / (2.0 * np.pi))).astype(np.int64).astype(np.uint16)
    )
    dx = (events.margin - events.radius * np.cos(angle)).astype(np.float32)
    dy = (events.margin - events.radius * np.sin(angle)).astype(np.float32)
    return Peer(
        lambda: kernel(events.x, events.y, turn, dx, dy, images, total), lambda: total, events
    )


def _in_torch(events: PeerEvents, device: str) -> tuple[Any, list[Any]]:
    """Return PyTorch, and x, y and angle of the events as its tensors on the device."""
    torch = library("torch")
    if device != "cpu" and not torch.cuda.is_available():
        raise Missing("this PyTorch has no CUDA")
    arrays = (events.x, events.y, events.angle)
    return torch, events.keep(
        ("torch", device),
        lambda: [torch.from_numpy(a.astype(np.float32)).to(device) for a in arrays],
    )


def with_torch(events: PeerEvents, device: str, *, block: int | None = None) -> Peer:
    """Prepare PyTorch: four calls of ``index_add_`` over whole arrays or blocks."""
    torch, (x, y, angle) = _in_torch(events, device)
    radius, margin, (rows, columns) = events.radius, events.margin, events.shape
    image = torch.zeros(rows * columns, device=device)

    def run() -> None:
        image.zero_()
        for start in range(0, len(x), block or len(x)):
            part = slice(start, start + (block or len(x)))
            u = x[part] - radius * torch.cos(angle[part]) + margin
            v = y[part] - radius * torch.sin(angle[part]) + margin
            i, j = u.to(torch.int32), v.to(torch.int32)
            fx, fy = u - i, v - j
            cell = j * columns + i
            image.index_add_(0, cell, (1 - fx) * (1 - fy))
            image.index_add_(0, cell + 1, fx * (1 - fy))
            image.index_add_(0, cell + columns, (1 - fx) * fy)
            image.index_add_(0, cell + columns + 1, fx * fy)

    return Peer(run, lambda: image.cpu().numpy(), events)


def with_torch_index_put(events: PeerEvents, device: str) -> Peer:
    """Prepare PyTorch as event_utils' ``events_to_image_torch`` votes: four ``index_put_`` with a row and a column."""
    torch, (x, y, angle) = _in_torch(events, device)
    radius, margin = events.radius, events.margin
    image = torch.zeros(events.shape, device=device)

    def run() -> None:
        image.zero_()
        u = x - radius * torch.cos(angle) + margin
        v = y - radius * torch.sin(angle) + margin
        i, j = torch.floor(u), torch.floor(v)
        fx, fy = u - i, v - j
        i, j = i.long(), j.long()
        image.index_put_((j, i), (1 - fx) * (1 - fy), accumulate=True)
        image.index_put_((j, i + 1), fx * (1 - fy), accumulate=True)
        image.index_put_((j + 1, i), (1 - fx) * fy, accumulate=True)
        image.index_put_((j + 1, i + 1), fx * fy, accumulate=True)

    return Peer(run, lambda: image.cpu().numpy(), events)


def _cupy_events(events: PeerEvents, device: str) -> tuple[Any, list[Any]]:
    """Return the module CuPy, and x, y and angle of the events on the device."""
    cupy = library("cupy")
    if device == "cpu":
        raise Missing("CuPy runs only on CUDA")
    arrays = (events.x, events.y, events.angle)
    return cupy, events.keep(("cupy", device), lambda: [cupy.asarray(a) for a in arrays])


def with_cupy(events: PeerEvents, device: str) -> Peer:
    """Prepare CuPy: array operations and four calls of ``add.at``."""
    cupy, (x, y, angle) = _cupy_events(events, device)
    radius, margin, (rows, columns) = (
        np.float32(events.radius),
        np.float32(events.margin),
        events.shape,
    )
    image = cupy.zeros(rows * columns, cupy.float32)

    def run() -> None:
        image.fill(0)
        u = x - radius * cupy.cos(angle) + margin
        v = y - radius * cupy.sin(angle) + margin
        i, j = u.astype(cupy.int32), v.astype(cupy.int32)
        fx, fy = u - i.astype(cupy.float32), v - j.astype(cupy.float32)
        cell = j * columns + i
        cupy.add.at(image, cell, (1 - fx) * (1 - fy))
        cupy.add.at(image, cell + 1, fx * (1 - fy))
        cupy.add.at(image, cell + columns, (1 - fx) * fy)
        cupy.add.at(image, cell + columns + 1, fx * fy)

    return Peer(run, lambda: cupy.asnumpy(image), events)


CUDA_SOURCE = r"""
extern "C" __global__ void votes(const unsigned short* x, const unsigned short* y, const float* angle, long long n,
                                 float radius, float margin, int columns, float* image) {
    const long long k = (long long)blockDim.x * blockIdx.x + threadIdx.x;
    if (k >= n) return;
    float s, c;
    __sincosf(angle[k], &s, &c);
    const float u = x[k] - radius * c + margin, v = y[k] - radius * s + margin;
    const int i = (int)u, j = (int)v;
    const float fx = u - i, fy = v - j;
    float* p = image + j * columns + i;
    atomicAdd(p, (1 - fx) * (1 - fy));
    atomicAdd(p + 1, fx * (1 - fy));
    atomicAdd(p + columns, (1 - fx) * fy);
    atomicAdd(p + columns + 1, fx * fy);
}
"""


def with_cupy_kernel(events: PeerEvents, device: str) -> Peer:
    """Prepare CuPy's ``RawKernel`` with CUDA C++: four float atomics per event."""
    cupy, (x, y, angle) = _cupy_events(events, device)
    kernel, n = cupy.RawKernel(CUDA_SOURCE, "votes"), len(x)
    image = cupy.zeros(events.shape, cupy.float32)
    sizes = np.float32(events.radius), np.float32(events.margin), np.int32(events.shape[1])
    inputs = (x, y, angle, np.int64(n), *sizes, image)

    def run() -> None:
        image.fill(0)
        kernel((-(-n // 256),), (256,), inputs)

    return Peer(run, lambda: cupy.asnumpy(image), events)


def _torch(events: PeerEvents, device: str) -> Peer:
    return with_torch(events, device, block=BLOCK if device == "cpu" else None)


PEERS: dict[str, Callable[[PeerEvents, str], Peer]] = {
    "NumPy": partial(with_numpy, block=BLOCK),
    "Numba": with_numba,
    "Numba, table": with_numba_table,
    "PyTorch": _torch,
    "CuPy": with_cupy,
    "CuPy, CUDA C++": with_cupy_kernel,
}
"""Fastest implementation with each library, by name of the library."""
ON_CPU = ("NumPy", "Numba", "Numba, table")
"""Names of the implementations that run on the CPU for every device."""
