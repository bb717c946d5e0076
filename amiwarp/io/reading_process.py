"""Separate process that reads files, so that a damaged file which crashes or hangs a decoder causes only an error.

HDF5 with its filters and the readers of ROS bags trust a file's content. The process that runs them is started by
``subprocess``, not ``multiprocessing``, so that a user's script is not imported again. It runs functions of amiwarp
that return a JSON value and arrays, which are sent through pipes. :mod:`amiwarp.io.reading_server` runs in the process.
"""

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import input_folder, input_path
from amiwarp.io.reading_server import advance, begin, forget, prepare

CPU_SECONDS = 3.0
"""Processor time that a file of at most :data:`SMALL_BYTES` may take [s]; see :class:`Allowance`. Unlike elapsed time,
it does not depend on the machine's load."""

SMALL_BYTES = 10_000_000
"""Size above which the processor time grows with the size of the file [bytes]."""

MEMORY_BYTES = 1 << 30
"""Limit of the additional memory of one request [bytes]."""

PIPE_BYTES = 1 << 20
"""Size of the pipe from the reading process [bytes], if the system supports it. A larger pipe needs fewer process
switches."""

LEAST_SECONDS = 0.01
"""Least processor time of a request [s], because the system counts it in steps."""

SECONDS_PER_BYTE = 1e-6
"""Processor time that is allowed for each byte of packets, so that the time of a long recording does not count [s]."""

CRASHES = [
    getattr(signal, name)
    for name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE", "SIGILL", "SIGTRAP", "SIGSYS")
    if hasattr(signal, name)
]
"""Signals by which the system ends a program with an error of its own. Others come from other programs."""

START = (
    "import sys; sys.path[:] = sys.argv[1:]; from amiwarp.io.reading_server import serve; serve()"
)
"""Python program that the reading process runs."""

Function: TypeAlias = str | Callable[..., Any]
"""Function of amiwarp that the process runs: itself, or ``module:function`` if only the process imports its module."""


class Allowance:
    """Processor time that a file may still take in reading processes: for its opening, and later for each result.

    Several requests, also in several processes, share it. Starting a process does not count.
    """

    def __init__(self, *arguments: Any, small_s: float | None = None) -> None:
        """Allow the time for the files and folders among the arguments of a request.

        ``small_s``: time for files of at most :data:`SMALL_BYTES` together [s], by default :data:`CPU_SECONDS`.
        """
        size = sum(_size(value) for value in arguments if isinstance(value, Path))
        least = CPU_SECONDS if small_s is None else small_s
        self.seconds = least * max(1.0, size / SMALL_BYTES)
        """The whole time [s]."""
        self.left = self.seconds
        """The remaining time [s]."""

    def renew(self, share: float = 1.0) -> None:
        """Allow this share of the whole time again, because the file has given results."""
        self.left = min(self.seconds, self.left + share * self.seconds)

    def exceeded(self) -> AmiwarpError:
        """Return the error to raise for a file that takes too long."""
        whole = f"{self.seconds:.3g} s of processor time"
        return AmiwarpError(
            f"reading took over {whole}, the limit for its size; the file is damaged",
            ErrorCode.FILE_DAMAGED,
        )


def _size(path: Path) -> int:
    """Return the size of a file, or of the files in a folder [bytes]; 0 for one that cannot be read."""
    try:
        files = path.iterdir() if path.is_dir() else [path]
        return sum(file.stat().st_size for file in files)
    except OSError:
        # The request reports it.
        return 0


class ReadingProcess:
    """Process that reads files for one reader at a time. Only one thread may use it at a time."""

    def __init__(self) -> None:
        """Start the process. Raises :class:`OSError` if it cannot be started."""
        root = str(Path(__file__).resolve().parents[2])
        # The process gets this module path, so that it imports the same modules without the start-up time of site.
        paths = [root, *(os.path.abspath(path) for path in sys.path if path != root)]
        self.owner = os.getpid()
        # In a new session and without signals that end a command, even if they go to all processes of a container or
        # a service: they reach only this process, which then ends the other.
        with _signals_blocked():
            self._child = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", START, *paths],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                start_new_session=True,
            )
        self._preparing = False
        self._keeps = False
        """Whether the process keeps values for the present reader."""
        self._allowance = Allowance()
        """Allowance of the request that was sent last."""
        self._requests: Any = self._child.stdin
        self._replies: Any = self._child.stdout
        self.close = weakref.finalize(self, _end, self._child, self.owner)
        with contextlib.suppress(ImportError, AttributeError, OSError):
            import fcntl

            assert self._child.stdout is not None
            fcntl.fcntl(self._child.stdout, fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    @property
    def usable(self) -> bool:
        """Whether the process is alive and was started by this process. A fork of its owner cannot use it."""
        return self.close.alive and self.owner == os.getpid() and self._child.poll() is None

    def call(
        self,
        function: Function,
        *arguments: Any,
        allowance: Allowance | None = None,
        share: float = 1.0,
    ) -> tuple[Any, list[NDArray[Any]]]:
        """Run a function of amiwarp, and return its JSON value and its arrays, each of shape ``(n,)``.

        Raises
        ------
        AmiwarpError
            If the function raises, or if the process crashes or exceeds this ``share`` of the ``allowance``. By
            default, the allowance is for the paths among the arguments.
        """
        self.send(function, *arguments, allowance=allowance, share=share)
        return self.receive()

    def prepare(self, module: str) -> None:
        """Let the process import a module, without waiting for it. The next call waits."""
        self.send(prepare, module)
        self._preparing = True

    def send(
        self,
        function: Function,
        *arguments: Any,
        allowance: Allowance | None = None,
        share: float = 1.0,
    ) -> None:
        """Send a call to the process; :meth:`receive` returns its result.

        A path among the arguments is an input: it is checked and noted here, and sent as an absolute path.
        """
        if self._preparing:
            self._preparing = False
            self.receive()
        self._allowance = Allowance(*arguments) if allowance is None else allowance
        if self._allowance.left <= 0.0:
            raise self._allowance.exceeded()
        self._cpu_s = max(self._allowance.left * share, LEAST_SECONDS)
        sent = [_absolute(value) if isinstance(value, Path) else value for value in arguments]
        request = {
            "function": name_of(function),
            "arguments": sent,
            "cpu_s": self._cpu_s,
            "memory_bytes": MEMORY_BYTES,
        }
        try:
            self._requests.write(json.dumps(request).encode() + b"\n")
            self._requests.flush()
        except OSError as error:
            raise self._ended() from error

    def receive(self) -> tuple[Any, list[NDArray[Any]]]:
        """Wait for the result of the call that :meth:`send` started."""
        try:
            (length,) = struct.unpack("<I", self._fill(bytearray(4)))
            reply = json.loads(self._fill(bytearray(length)))
            arrays = [np.empty(count, dtype) for dtype, count in reply.get("arrays", ())]
            for array in arrays:
                if array.size:
                    self._fill(array.view(np.uint8).data)
        except BaseException:
            # The rest of this reply must not be read as the next reply.
            self.close()
            raise
        self._keeps = reply["keeps"]
        self._allowance.left -= reply["cpu_s"]
        if "error" in reply:
            raise AmiwarpError(reply["error"], ErrorCode(reply.get("code", ErrorCode.INVALID)))
        return reply["result"], arrays

    def forget(self) -> None:
        """Let the process close and drop all values that it keeps for a reader."""
        if self._keeps:
            self.call(forget)

    def _fill(self, buffer: Any) -> Any:
        if self._replies.readinto(buffer) != len(buffer):
            raise self._ended()
        return buffer

    def _ended(self) -> AmiwarpError:
        """Return the error to raise for a reading process that has ended."""
        code = self._child.wait()
        self.close()
        if code == -getattr(signal, "SIGPROF", 0):
            self._allowance.left -= self._cpu_s
            return self._allowance.exceeded()
        if code < 0 and -code in CRASHES:
            return AmiwarpError(
                f"reading crashed its process ({signal.Signals(-code).name}); the file is damaged",
                ErrorCode.FILE_DAMAGED,
            )
        if code < 0:
            name = signal.Signals(-code).name
            return AmiwarpError(
                f"the reading process was ended by {name}; check that enough memory is free, and retry"
            )
        remedy = f"check that '{sys.executable}' is Python and that enough memory is free"
        return AmiwarpError(f"the reading process ended with code {code}; {remedy}")


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    """Postpone the signals that end a command, and let a process that is started meanwhile never get them."""
    # Windows has no such signals.
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    ending = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ending)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def name_of(function: Function) -> str:
    """Return the name by which the process finds a function: ``module:function``."""
    return function if isinstance(function, str) else f"{function.__module__}:{function.__name__}"


def _absolute(path: Path) -> str:
    return os.path.abspath(input_folder(path) if path.is_dir() else input_path(path))


def _end(child: subprocess.Popen[bytes], owner: int) -> None:
    """Kill a reading process, which holds no state worth saving. In a fork of its owner, do nothing."""
    if owner == os.getpid():
        child.kill()
        child.wait()
    for stream in (child.stdin, child.stdout):
        with contextlib.suppress(OSError):
            stream.close()  # type: ignore[union-attr]


_idle: list[ReadingProcess] = []
"""List of at most one reading process that waits for the next reader."""


# Garbage collection may run a finalizer that gives back a process at any point
_idle_lock = threading.RLock()


def borrow() -> ReadingProcess:
    """Take the idle reading process, or start a new one."""
    with _idle_lock:
        process = _idle.pop() if _idle else None
    if process is not None and process.usable:
        return process
    return ReadingProcess()


def start_ahead(module: str) -> None:
    """Start a reading process that imports ``module``, for the first reader, while this process does other things."""
    # The first reader tries again, and reports an error.
    with contextlib.suppress(OSError, AmiwarpError):
        process = ReadingProcess()
        process.prepare(module)
        _keep_idle(process)


def give_back(process: ReadingProcess) -> None:
    """Keep a reading process for the next reader, or end it. Starting one takes about 0.3 s."""
    if process.close.alive and process.owner == os.getpid():
        with contextlib.suppress(AmiwarpError):
            process.forget()
            # Its next reader finds out whether it is still alive.
            _keep_idle(process)
            return
    process.close()


def _keep_idle(process: ReadingProcess) -> None:
    """Keep a process for the next reader, or end it if another one waits."""
    with _idle_lock:
        if not _idle:
            _idle.append(process)
            return
    process.close()


def run(function: Function, *arguments: Any) -> Any:
    """Run one function in a reading process, and return its JSON value."""
    return run_with_arrays(function, *arguments)[0]


def run_with_arrays(function: Function, *arguments: Any) -> tuple[Any, list[NDArray[Any]]]:
    """Run one function in a reading process, and return its JSON value and its arrays."""
    process = borrow()
    try:
        return process.call(function, *arguments)
    finally:
        give_back(process)


def packets(function: Function, *arguments: Any) -> Iterator[Any]:
    """Yield the packets of a generator that runs in a reading process.

    A packet is a tuple of arrays. Small packets are joined to larger ones. The process decodes one packet ahead. The
    last argument is a dictionary of counts, which is updated from the dictionary that the generator gets first.
    """
    *given, notes = arguments
    allowance = Allowance(*given)
    process = borrow()
    try:
        process.call(begin, name_of(function), *given, allowance=allowance)
        process.send(advance, allowance=allowance)
        waiting = True
        try:
            while True:
                waiting = False
                found, arrays = process.receive()
                notes.update(found)
                if not arrays:
                    return
                size = sum(array.nbytes for array in arrays)
                allowance.renew(size * SECONDS_PER_BYTE / allowance.seconds)
                process.send(advance, allowance=allowance)
                waiting = True
                yield tuple(arrays)
        finally:
            if waiting and process.usable:
                with contextlib.suppress(AmiwarpError):
                    process.receive()
    finally:
        give_back(process)
