"""Kernel launches: single ones, slices on a thread pool, and recorded programs; page-locked memory."""

import contextlib
import heapq
import os
import sys
import tempfile
import weakref
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue
from threading import Lock, Thread, get_ident, main_thread
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.tasks import Progress, cores, cpu_threads, in_order, silent, works_on_one_core

# Kernel launches: a single launch on CUDA, slices on a thread pool on the CPU.
#
# Warp itself runs each CPU launch on one thread.

_Job = tuple[Callable[[], object], "SimpleQueue[BaseException | None]"]
"""Function to run, and the queue that gets its error, or None."""
_specialising = Lock()
_loading: defaultdict[str, Lock] = defaultdict(Lock)
_loaded: set[tuple[str, str]] = set()
"""Names of the modules that are loaded, each with its device."""
_header: list[Any] = []
"""Folder of the header that Warp precompiled for CPUs, or empty before the first compilation."""
_heading = Lock()
BLOCK_DIM = 256  # CUDA threads per block; block sums require full blocks
SMALLEST_SLICE = 1 << 15  # fewest threads per slice: launching a smaller slice takes longer than running it


# Background work has two kinds of worker: a job with a result runs in a pool, and a loop that runs until it is closed
# has a daemon thread of its own. The helpers are a pool that hands over faster, for the jobs of one launch.


@cache
def pool() -> ThreadPoolExecutor:
    """Return the shared thread pool for CPU launches, with one thread per core."""
    return ThreadPoolExecutor(cores(), thread_name_prefix="amiwarp")


class _Helpers:
    """Threads that run jobs for other threads. A hand-over takes a third of that to a ``ThreadPoolExecutor``."""

    def __init__(self) -> None:
        """Start without threads."""
        self._jobs: SimpleQueue[_Job] = SimpleQueue()
        self._threads = 0
        self._starting = Lock()

    def put(self, jobs: list[_Job]) -> None:
        """Queue jobs, for at least as many threads."""
        with self._starting:
            while self._threads < len(jobs):
                Thread(target=self._work, name=f"amiwarp-helper-{self._threads}", daemon=True).start()
                self._threads += 1
        for job in jobs:
            self._jobs.put(job)

    def _work(self) -> None:
        while True:
            job, done = self._jobs.get()
            error = None
            try:
                job()
            except BaseException as raised:
                error = raised
            done.put(error)
            del job, done, error  # so that their arrays are freed while the thread waits


_helpers = cache(_Helpers)


def run_together(jobs: Sequence[Callable[[], object]]) -> None:
    """Run jobs at the same time, the first one in this thread, and wait for all of them.

    A job must not call this function. In a thread that works on one core, they run one after the other.
    """
    if works_on_one_core():
        for job in jobs:
            job()
        return
    done: SimpleQueue[BaseException | None] = SimpleQueue()
    if len(jobs) > 1:
        _helpers().put([(job, done) for job in jobs[1:]])
    try:
        jobs[0]()
    finally:
        errors = [done.get() for _ in jobs[1:]]
    for error in errors:
        if error is not None:
            raise error


@cache
def background_worker() -> ThreadPoolExecutor:
    """Return the shared background worker: a pool of one thread, which keeps the order of its jobs."""
    return ThreadPoolExecutor(1, thread_name_prefix="amiwarp-background-worker")


if hasattr(os, "register_at_fork"):  # a fork has none of the threads
    for _started in (pool, _helpers, background_worker):
        os.register_at_fork(after_in_child=_started.cache_clear)


def specialised(kernel: Any, inputs: Sequence[Any]) -> Any:
    """Return a generic kernel for the structs among its inputs, alone in a module; return any other kernel as it is.

    So only the optical models that are used are compiled, and a new one does not compile the others again.
    """
    generic = _generic_arguments(kernel)
    if not generic:
        return kernel
    with _specialising:
        return _specialised(kernel, tuple(getattr(inputs[k], "_cls", None) or inputs[k].dtype for k in generic))


@cache
def _generic_arguments(kernel: Any) -> dict[int, Any]:
    """Return a kernel's generic arguments by their positions: structs, and arrays of structs.

    A kernel that has overloads already is not generic.
    """
    arguments = enumerate(() if kernel.overloads else kernel.adj.args)
    return {k: argument for k, argument in arguments if Any in (argument.type, getattr(argument.type, "dtype", None))}


@cache
def _specialised(kernel: Any, structs: tuple[Any, ...]) -> Any:
    """Return a generic kernel for the structs in the order of its generic arguments."""
    module = wp.get_module(".".join([kernel.module.name, kernel.key, *(struct.key for struct in structs)]))
    module.options.update(kernel.module.options)
    types = {
        argument.label: struct if argument.type is Any else wp.array(dtype=struct)
        for argument, struct in zip(_generic_arguments(kernel).values(), structs, strict=True)
    }
    bounds = kernel.options.get("launch_bounds")
    return wp.overload(wp.kernel(kernel.func, module=module, launch_bounds=bounds), types)


def load(kernel: Any, device: Any) -> None:
    """Compile and load a kernel's module with the block size that launches here use, at the first call.

    Call it before several threads launch the kernel, or each of them would try to compile it. A call waits for a
    running one for the same module.
    """
    name = (kernel.module.name, device.alias)
    if name in _loaded:
        return
    with _loading[kernel.module.name]:
        if not device.is_cpu or _has_header():
            kernel.module.load(device, block_dim=1 if device.is_cpu else None)
        else:
            with _heading:
                _has_header()
                kernel.module.load(device, block_dim=1)
                if get_ident() in _headers():
                    _header.append(_headers()[get_ident()])
        _loaded.add(name)


def _headers() -> dict[int, Any]:
    """Return Warp's folders of its precompiled header for CPUs, by thread."""
    return getattr(wp._src.context.runtime, "_pch_dirs", {})


def _has_header() -> bool:
    """Give this thread the header that the first one to compile made, which takes three seconds, if there is one.

    Warp makes it once per thread. If a later version keeps it elsewhere, it does so again.
    """
    if _header:
        _headers().setdefault(get_ident(), _header[0])
    return bool(_header)


def load_kernels(kernels: Iterable[tuple[Any, ...]], device: Any) -> None:
    """Compile and load kernels. Each is followed by the structs of its generic arguments.

    A module that another thread is loading is left to that thread.
    """
    for kernel, *structs in kernels:
        with _specialising:
            one = _specialised(kernel, tuple(structs)) if structs else kernel
        if not _loading[one.module.name].locked():
            load(one, wp.get_device(device))


def load_ahead(kernels: Iterable[tuple[Any, ...]], device: Any) -> None:
    """Compile and load kernels as :func:`load_kernels` does, in the background, until the program ends."""
    device = wp.get_device(device)  # before the threads start, or each of them would initialise Warp
    left, taking = iter(kernels), Lock()

    def wanted() -> Iterator[tuple[Any, ...]]:
        while main_thread().is_alive():
            with taking:
                one = next(left, None)
            if one is None:
                return
            yield one

    for k in range(2):
        Thread(target=load_kernels, args=(wanted(), device), name=f"amiwarp-compiler-{k}").start()


def load_all(device: Any, progress: Progress = silent) -> None:
    """Compile and load the kernels of all imported modules, several at a time, except those for one optical model.

    Processes that start later find them in Warp's cache. Processes that start together would all compile them.
    """
    names = [name for name in list(sys.modules) if name.startswith(f"{__package__}.")]
    found = [one for name in names for one in vars(sys.modules[name]).values() if isinstance(one, wp.Kernel)]
    kernels = {kernel.module.name: kernel for kernel in found if not _generic_arguments(kernel)}
    jobs = [partial(load, kernel, wp.get_device(device)) for kernel in kernels.values()]
    for k, _ in enumerate(in_order(jobs)):
        progress("compiling kernels", (k + 1) / len(jobs))


def slices(n: int, parts: int, smallest: int = SMALLEST_SLICE) -> list[tuple[int, int]]:
    """Return at most ``parts`` contiguous (start, stop) ranges that cover ``range(n)``.

    Each range has about ``smallest`` elements or more.
    """
    parts = max(1, min(parts, n // smallest))
    edges = [n * k // parts for k in range(parts + 1)]
    return list(pairwise(edges))


def launch(
    kernel: Any,
    n: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    device: Any,
    first: int = 0,
    smallest: int = SMALLEST_SLICE,
) -> None:
    """Run a kernel whose last input is ``start: int`` over ``range(first, first + n)``, on all cores of a CPU.

    Slices run at the same time, so no two threads of the kernel may write to the same element.
    """
    device = wp.get_device(device)
    if n == 0:
        return
    kernel = specialised(kernel, inputs)
    if not device.is_cpu:
        wp.launch(kernel, dim=n, inputs=[*inputs, first], outputs=list(outputs), device=device)
        return
    ranges = slices(n, cpu_threads(), smallest)
    load(kernel, device)

    def run(span: tuple[int, int]) -> None:
        inputs_ = [*inputs, first + span[0]]
        wp.launch(kernel, dim=span[1] - span[0], inputs=inputs_, outputs=list(outputs), device=device)

    run_together([partial(run, span) for span in ranges])


def launch_slices(
    kernel: Any,
    n: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    first: int = 0,
    smallest: int = SMALLEST_SLICE,
    clear: bool = False,
) -> None:
    """Run a kernel on a CPU as :func:`launch` does, but let slice k write into ``outputs[k]`` only.

    For kernels whose threads add to the same elements. The range is ``range(first, first + n)``. With ``clear``, all
    outputs are first set to zero, by the threads that write into them.
    """
    device, ranges = wp.get_device("cpu"), slices(n, len(outputs), smallest)
    kernel = specialised(kernel, inputs)
    load(kernel, device)

    def run(out: Any, start: int, stop: int) -> None:
        if clear:
            out.zero_()
        if stop > start:
            wp.launch(kernel, dim=stop - start, inputs=[*inputs, first + start], outputs=[out], device=device)

    ranges += [(0, 0)] * (len(outputs) - len(ranges) if clear else 0)
    run_together([partial(run, out, *span) for span, out in zip(ranges, outputs, strict=False)])


class RecordedLaunch:
    """Recorded kernel launch that can be repeated, which takes a tenth of the time of a new launch."""

    def __init__(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any], *, device: Any, n: int = 1) -> None:
        """Record the launch over ``range(n)`` without running it. Each repeat uses the same arrays."""
        device, kernel = wp.get_device(device), specialised(kernel, inputs)
        load(kernel, device)
        self._start, self._first = len(inputs) - 1, inputs[-1]
        self._command = wp.launch(
            kernel, n, list(inputs), list(outputs), device=device, block_dim=BLOCK_DIM, record_cmd=True
        )
        self.repeat: Callable[[], None] = self._command.launch
        """Function that runs the kernel once more; on a CPU in the calling thread only."""

    def set(self, index: int, value: Any) -> None:
        """Replace the argument at ``index`` for all later runs."""
        self._command.set_param_at_index(index, value)

    def __call__(self, first: int, n: int) -> None:
        """Run a kernel whose last input is ``start: int`` over ``range(first, first + n)``, as :attr:`repeat` does."""
        self._command.set_dim(n)
        if first != self._first:
            self._first = first
            self._command.set_param_at_index(self._start, first)
        self._command.launch()


class RepeatedLaunches:
    """Launches on a device that are repeated with few changes.

    On CUDA a launch keeps the arguments of the last one of its kernel, and converts only those that differ. That takes
    less than half of the time of :func:`launch`. The last arguments live as long as this object.
    """

    def __init__(self, device: Any) -> None:
        self._device = wp.get_device(device)
        self._last: dict[Any, tuple[RecordedLaunch, list[Any]]] = {}

    def __call__(
        self,
        kernel: Any,
        n: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        *,
        smallest: int = SMALLEST_SLICE,
    ) -> None:
        """Run a kernel over ``range(n)`` as :func:`launch` does."""
        if self._device.is_cpu or n == 0:
            launch(kernel, n, inputs, outputs, device=self._device, smallest=smallest)
            return
        kernel, arguments = specialised(kernel, inputs), [*inputs, 0, *outputs]
        recorded, last = self._last.pop(kernel, (None, []))
        if recorded is None:
            recorded, last = RecordedLaunch(kernel, [*inputs, 0], outputs, device=self._device), arguments
        for k, (value, old) in enumerate(zip(arguments, last, strict=True)):
            if value is not old or hasattr(value, "_cls"):  # the values of a struct may have changed
                recorded.set(k, value)
        self._last[kernel] = recorded, arguments
        recorded(0, n)


def slice_count(device: Any) -> int:
    """Return the number of slices of a launch on ``device``."""
    return cpu_threads() if wp.get_device(device).is_cpu else 1


# Programs of launches that run repeatedly on the same arrays: a CUDA graph, or recorded CPU slices.

FEW_LAUNCHES = 6  # launches that take less time than the capture of a graph
MOST_RUNS = 6  # runs that one CUDA graph may hold: launching a graph takes longer than a few small kernels


class Program:
    """Sequence of kernel launches that can be run many times.

    Arrays and numbers are those passed to :meth:`add`. A value that changes between runs must be stored in an array.
    """

    def __init__(self, device: Any) -> None:
        self.device = wp.get_device(device)
        self._stages: list[list[Callable[[], None]]] = []
        self._graphs: dict[int, Any] = {}

    def add(
        self,
        kernel: Any,
        n: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any],
        *,
        smallest: int = SMALLEST_SLICE,
    ) -> None:
        """Append a kernel over ``range(n)`` whose last input is ``start: int``.

        See :func:`amiwarp.kernels.launch.launch`. On CUDA the range is rounded up to whole blocks.
        """
        if n == 0:
            return
        ranges = [(0, -(-n // BLOCK_DIM) * BLOCK_DIM)]
        if self.device.is_cpu:
            ranges = slices(n, cpu_threads(), smallest)
        self._stages.append([self._record(kernel, span, inputs, outputs) for span in ranges])

    def add_slices(
        self, kernel: Any, n: int, inputs: Sequence[Any], outputs: Sequence[Any], *, smallest: int = SMALLEST_SLICE
    ) -> None:
        """Append a kernel as :meth:`add` does, but give each slice of its threads an output.

        Slice k writes ``outputs[k]``. On CUDA there is one slice with ``n`` threads, which writes ``outputs[0]``.
        """
        if n == 0:
            return
        ranges = slices(n, len(outputs), smallest) if self.device.is_cpu else [(0, n)]
        jobs = zip(ranges, outputs, strict=False)
        self._stages.append([self._record(kernel, span, inputs, [out]) for span, out in jobs])

    def _record(
        self, kernel: Any, span: tuple[int, int], inputs: Sequence[Any], outputs: Sequence[Any]
    ) -> Callable[[], None]:
        """Return a function that repeats the kernel's launch over a range."""
        first, stop = span
        return RecordedLaunch(kernel, [*inputs, first], outputs, device=self.device, n=stop - first).repeat

    def launch(self) -> None:
        """Run all stages once, in the order in which they were added."""
        for stage in self._stages:
            run_together(stage)

    def run(self, times: int = 1) -> None:
        """Run all stages ``times`` times; more than a few launches on CUDA run as graphs."""
        if self.device.is_cpu or times * len(self._stages) <= FEW_LAUNCHES:
            for _ in range(times):
                self.launch()
            return
        runs = max(n for n in range(1, MOST_RUNS + 1) if times % n == 0)
        graph = self._graph(runs)
        for _ in range(times // runs):
            wp.capture_launch(graph)

    def _graph(self, runs: int) -> Any:
        """Return the CUDA graph of a number of runs. The first call captures it."""
        if runs not in self._graphs:
            with wp.ScopedCapture(self.device) as capture:
                for _ in range(runs):
                    self.launch()
            self._graphs[runs] = capture.graph
        return self._graphs[runs]


# Start of Warp without the warning of a missing GPU driver.

NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"
"""Warning of Warp on machines without a GPU, which is no news there."""


GPU_FILES = (Path("/dev/nvidiactl"), Path("/dev/nvidia0"), Path("/dev/dxg"))
"""Files of Linux that exist if there is a GPU, the last one in Windows' subsystem for Linux. A driver without its
library is worth the warning there."""


def start_quietly() -> list[str]:
    """Initialise Warp and return the names of its devices."""
    has_gpu = any(file.exists() for file in GPU_FILES)
    with contextlib.nullcontext() if has_gpu else _without(NO_DRIVER):
        wp.init()
    return [device.alias for device in wp.get_devices()]


@cache
def start_once() -> None:
    """Initialise Warp as :func:`start_quietly` does, at the first call. For readers, which no device was chosen for."""
    start_quietly()


@contextlib.contextmanager
def _without(line: str) -> Iterator[None]:
    """Print what native code writes to stderr, except for one expected line."""
    sys.stderr.flush()
    original = os.dup(2)
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
            caught.seek(0)
            for text in caught.read().decode(errors="replace").splitlines():
                if line not in text:
                    print(text, file=sys.stderr, flush=True)


# Page-locked memory on the host, and reading from a GPU that does not wait at once.
#
# A GPU copies to and from page-locked memory at full speed and without waiting, but locking the memory takes up to two
# milliseconds. So arrays are used again.

_Kind = tuple[Any, ...]
"""What arrays that may take each other's place have in common: shape, type, and use."""
_Numbered = tuple[int, wp.array]
"""Number of an array among those of its kind, in the order in which they were made, and the array."""


class PageLockedPool:
    """Page-locked host arrays of Warp, which are used again once their owners are deleted."""

    def __init__(self, most: int | None = None, *, locked: bool = True) -> None:
        """Start without arrays. ``most``: largest number of :meth:`result` arrays of a kind.

        ``locked=False`` gives ordinary memory, for machines without CUDA.
        """
        self._most, self._locked = most, locked
        self._idle: defaultdict[_Kind, list[_Numbered]] = defaultdict(list)  # heaps
        self._made: Counter[_Kind] = Counter()

    def _take(self, kind: _Kind) -> _Numbered:
        """Return the idle array of a kind that was made first, so that few are in use, or a new one."""
        try:
            return heapq.heappop(self._idle[kind])
        except IndexError:
            shape, dtype, *_ = kind
            self._made[kind] += 1
            return self._made[kind], wp.empty(shape, dtype=dtype, device="cpu", pinned=self._locked)

    def _give_back(self, kind: _Kind, user: object, taken: _Numbered) -> None:
        """Make an array idle once ``user`` is deleted."""
        weakref.finalize(user, heapq.heappush, self._idle[kind], taken).atexit = False

    def array(self, owner: object, shape: tuple[int, ...], dtype: Any, *use: object) -> wp.array:
        """Return an array with undefined values, which another owner may get once ``owner`` is deleted.

        Keep no reference to it beyond ``owner``. ``use``: only an owner with the same use may get it.
        """
        kind = shape, dtype, *use
        taken = self._take(kind)
        self._give_back(kind, owner, taken)
        return taken[1]

    def fill(self, size: int, dtypes: Iterable[Any]) -> None:
        """Lock memory for the :meth:`result` arrays of each of ``dtypes`` in advance."""
        for kind, taken in [(kind, self._take(kind)) for kind in [((size,), dtype) for dtype in dtypes]]:
            heapq.heappush(self._idle[kind], taken)

    def result(self, size: int, n: int, dtype: Any) -> tuple[wp.array, NDArray[Any]]:
        """Return an array of ``size`` values, and a NumPy view of its first ``n``, which a caller may keep.

        The array is used again once all views of it are dropped. If a caller keeps too many, ordinary memory is handed
        out.
        """
        kind = (size,), dtype
        if self._most is not None and not self._idle[kind] and self._made[kind] >= self._most:
            view = np.empty(n, wp.dtype_to_numpy(dtype))
            return wp.array(view, dtype=dtype, device="cpu", copy=False), view
        taken = self._take(kind)
        # Not a slice: NumPy makes a slice of a slice refer to the base, and the pool would miss that it is in use.
        view = np.frombuffer(memoryview(taken[1].numpy()), wp.dtype_to_numpy(dtype), n)
        self._give_back(kind, view, taken)
        return taken[1], view


_shared = PageLockedPool()


def page_locked(
    owner: object, shape: tuple[int, ...], dtype: Any, device: Any, *, written_by_host: bool = False
) -> wp.array:
    """Return a page-locked array with undefined values, which another owner may get once ``owner`` is deleted.

    ``device`` may use it only on Warp's stream, so that what it does for an earlier owner comes first. Only one side
    writes to it: ``device``, or the host. Keep no reference to it beyond ``owner``.
    """
    return _shared.array(owner, shape, dtype, str(device), written_by_host)


def start_read(array: wp.array) -> Callable[[], NDArray[Any]]:
    """Start to copy a small contiguous array of numbers to the host. Return a function that waits and returns a copy.

    It does not wait for what is launched later.
    """
    if array.device.is_cpu:
        found = array.numpy().copy()
        return lambda: found
    size = array.size * wp.types.type_size_in_bytes(array.dtype)

    def result() -> NDArray[Any]:
        wp.synchronize_event(copied)
        values: NDArray[Any] = host.numpy()[:size].view(wp.dtype_to_numpy(array.dtype))
        return values.reshape(array.shape).copy()

    # sizes are powers of two, so that arrays of other sizes can use the memory, too
    host = page_locked(result, (1 << (size - 1).bit_length(),), wp.uint8, array.device)
    wp.copy(host, wp.array(ptr=array.ptr, dtype=wp.uint8, shape=size, device=array.device), count=size)
    copied = array.device.stream.record_event()
    return result
