"""The circle's image in other libraries, as their users would write it: x - r cos, y - r sin, four bilinear votes.

Each holds x, y and the angle within a turn before the clock starts: as uint16 and float32, and PyTorch, which has
little use for uint16, all as float32. The image has a margin that no event leaves, so that nobody needs to look for its
border. Speed and error of these are what amiwarp's are held against; nothing here is used for anything else.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.kernels.cores import cpu_threads

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK = 1 << 16
"""Events that stay in a CPU's cache while NumPy and PyTorch go over them array by array."""


class Missing(Exception):
    """A library that is not installed, or does not run on this device: the row is skipped, and says so."""


@dataclass(frozen=True, slots=True, eq=False)
class PeerEvents:
    """Events as the users of other libraries hold them, and the circle that is to be taken out."""

    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    angle: NDArray[np.float32]
    """Of the displacement, within a turn [rad]."""
    radius: float
    """Of the circle [px]."""
    width: int
    height: int
    margin: int
    """Around the image, that no event leaves [px]: more than the radius, and one."""
    _kept: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image, its margin included."""
        return self.height + 2 * self.margin, self.width + 2 * self.margin

    def keep(self, key: Any, make: Callable[[], Any]) -> Any:
        """What ``make`` gives, made once."""
        if key not in self._kept:
            self._kept[key] = make()
        return self._kept[key]

    def places(self, which: slice) -> NDArray[np.float32]:
        """Where the formula in float32 puts events [px], shape (n, 2)."""
        angle, radius = self.angle[which], np.float32(self.radius)
        xy = np.stack([self.x[which], self.y[which]], axis=1).astype(np.float32)
        return np.asarray(xy - radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@dataclass(frozen=True, slots=True)
class Peer:
    """One library with the events in place."""

    run: Callable[[], Any]
    """One pass, which is timed. On CUDA it may return before the device is done."""
    with_margin: Callable[[], Any]
    events: PeerEvents

    def image(self) -> NDArray[np.floating[Any]]:
        """What the latest pass left, without the margin, shape (height, width)."""
        m = self.events.margin
        return np.asarray(self.with_margin()).reshape(self.events.shape)[m:-m, m:-m]


def library(name: str) -> Any:
    """Raises :class:`Missing` where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise Missing(f"{name} is not installed") from error


def with_numpy(events: PeerEvents, device: str, *, block: int | None = None) -> Peer:
    """Four ``add.at``, which in NumPy 2 beat ``bincount`` with weights; over whole arrays, or in blocks."""
    x, y, angle, radius, margin = events.x, events.y, events.angle, np.float32(events.radius), np.float32(events.margin)
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
    """Sine and cosine an event, and from a table of a turn's angles; each thread has an image of its own."""
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

    def by_sine(x: Any, y: Any, angle: Any, radius: Any, margin: Any, images: Any, total: Any) -> None:
        n, parts = len(x), len(images)
        for k in nb.prange(parts):
            images[k] = 0.0
            for e in range(n * k // parts, n * (k + 1) // parts):
                c, s = np.cos(angle[e]), np.sin(angle[e])
                cast(images[k], np.float32(x[e]) - radius * c + margin, np.float32(y[e]) - radius * s + margin)
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
    """Parallel and with ``fastmath``."""
    kernel, _ = numba_kernels()
    images, total = _numba_images(events)
    sizes = np.float32(events.radius), np.float32(events.margin)
    inputs = (events.x, events.y, events.angle, *sizes, images, total)
    return Peer(lambda: kernel(*inputs), lambda: total, events)


def with_numba_table(events: PeerEvents, device: str) -> Peer:
    """The same, given angles in 16 bits as amiwarp's events have, and a table of displacements."""
    _, kernel = numba_kernels()
    images, total = _numba_images(events)
    angle = np.arange(65536) * (2.0 * np.pi / 65536)
    turn = np.rint(events.angle * np.float64(65536 / (2.0 * np.pi))).astype(np.int64).astype(np.uint16)
    dx = (events.margin - events.radius * np.cos(angle)).astype(np.float32)
    dy = (events.margin - events.radius * np.sin(angle)).astype(np.float32)
    return Peer(lambda: kernel(events.x, events.y, turn, dx, dy, images, total), lambda: total, events)


def with_torch(events: PeerEvents, device: str, *, block: int | None = None) -> Peer:
    """Four ``index_add_``; over whole arrays, or in blocks."""
    torch = library("torch")
    if device != "cpu" and not torch.cuda.is_available():
        raise Missing("this PyTorch has no CUDA")
    arrays = (events.x, events.y, events.angle)
    x, y, angle = events.keep(
        ("torch", device), lambda: [torch.from_numpy(a.astype(np.float32)).to(device) for a in arrays]
    )
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


def _cupy_events(events: PeerEvents, device: str) -> tuple[Any, list[Any]]:
    """The library, and x, y, angle on the device."""
    cupy = library("cupy")
    if device == "cpu":
        raise Missing("CuPy runs on CUDA alone")
    arrays = (events.x, events.y, events.angle)
    return cupy, events.keep(("cupy", device), lambda: [cupy.asarray(a) for a in arrays])


def with_cupy(events: PeerEvents, device: str) -> Peer:
    """Arrays, and four ``add.at``."""
    cupy, (x, y, angle) = _cupy_events(events, device)
    radius, margin, (rows, columns) = np.float32(events.radius), np.float32(events.margin), events.shape
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
    """CUDA C++ through ``RawKernel``, four float atomics an event."""
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
"""The fastest way with each, by name. NumPy and Numba work on the CPU whatever the device."""
ON_CPU = ("NumPy", "Numba", "Numba, table")
