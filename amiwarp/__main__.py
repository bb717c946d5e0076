"""Entry point of ``python -m amiwarp`` and of the ``amiwarp`` command."""

import gc
import io
import os
import signal
import sys
from typing import Any

from amiwarp.cli import INTERRUPTED, STOPPED, fail

ENDING = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
"""Signals that end a command: Ctrl-C, and those that end it in the same way."""
MOST_NEW = 100_000
"""New objects after which garbage is collected. With Python's 700, that takes a quarter of the time of the imports."""


def main() -> None:
    """Run the command line and end the process.

    After an interrupt the process ends without Python's own clean-up, in which a compiled library may crash if it was
    interrupted while loading. Commands release their resources before.
    """
    try:
        _main()
    except SystemExit as end:
        if end.code != INTERRUPTED:
            raise
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(INTERRUPTED)


def _end_loading(number: int, frame: Any) -> None:
    """End the process at a signal: nothing is open yet, and Python drops an exception that meets a finaliser."""
    os.write(2, f"amiwarp: {STOPPED}\n".encode())
    os._exit(INTERRUPTED)


def _main() -> None:
    """Load the command line, which takes some time, and run the command."""
    try:
        if isinstance(
            sys.stdout, io.TextIOWrapper
        ):  # of Windows, it may lack characters of a file's name
            sys.stdout.reconfigure(errors="backslashreplace")
        # a signal that nohup ignores stays ignored
        ending = [
            n for n in ENDING if signal.getsignal(n) in (signal.SIG_DFL, signal.default_int_handler)
        ]
        for number in ending:
            signal.signal(number, _end_loading)
        gc.set_threshold(MOST_NEW)
        if any(
            argument.endswith((".h5", ".hdf5")) and os.path.isfile(argument)
            for argument in sys.argv[1:]
        ):
            from amiwarp.io.reading_process import start_ahead

            start_ahead("amiwarp.io.hdf5.server")  # loads HDF5 while this process loads the command
        if sys.argv[1:2] == ["demo"] and "--help" not in sys.argv:
            from amiwarp.kernels.checksum import compute_checksums
            from amiwarp.kernels.loading import load_ahead
            from amiwarp.kernels.quiet_start import start_quietly

            if start_quietly() == ["cpu"]:  # with a GPU, the demo runs there
                load_ahead([(compute_checksums,)], "cpu")  # precompiles Warp's header meanwhile
            import amiwarp.studies.demo  # noqa: F401
        from amiwarp.cli import app

        for number in ending:
            signal.signal(number, signal.default_int_handler)
        app.main()
    except KeyboardInterrupt:  # Ctrl-C during loading, or before or after a command
        fail(INTERRUPTED, STOPPED)


if __name__ == "__main__":
    main()
