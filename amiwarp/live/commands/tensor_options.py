"""Options of ``amiwarp live`` for tensors of its events at a steady rate."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from amiwarp.cli import common as cli
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.tensor_file import TensorWriter

if TYPE_CHECKING:
    from amiwarp.imaging.tensor_stream import StreamTensor
    from amiwarp.imaging.to_tensor import ToTensor
    from amiwarp.live.stream.sinks import Sink
    from amiwarp.live.stream.tensor_output import TensorOutput

_in_tensors = partial(typer.Option, rich_help_panel="Tensors")
BINS = 5
"""Time bins of a tensor, by default."""
TENSOR_HZ = 30.0
"""Tensors per second of the stream, by default [Hz]."""


@dataclass(frozen=True)
class TensorOptions:
    """Options of the tensors, and of the file or address that gets them."""

    tensor: Annotated[
        Literal["voxel", "count", "polarity", "stack"] | None,
        _in_tensors(
            help="Make tensors of the events after the last stage: voxel grids, events per pixel, OFF and ON events "
            "per pixel, or these in time bins."
        ),
    ] = None
    tensor_hz: Annotated[
        float, _in_tensors(min=0.1, max=1e5, help="Tensors per second of the stream (Hz).")
    ] = TENSOR_HZ
    tensor_bins: Annotated[
        int, _in_tensors(min=1, max=1024, help="Time bins of voxel and stack.")
    ] = BINS
    tensor_out: Annotated[
        Path | None, _in_tensors(help="File of the tensors to write (.h5)."), cli.OUTPUT
    ] = None
    tensor_to: Annotated[
        str | None,
        _in_tensors(
            help="Address to serve the tensors at: tcp:HOST:PORT or unix:PATH.", metavar="ADDRESS"
        ),
    ] = None

    def __post_init__(self) -> None:
        has_output = self.tensor_out is not None or self.tensor_to is not None
        if self.tensor is None:
            settings = (self.tensor_hz, self.tensor_bins)
            if has_output or settings != (TENSOR_HZ, BINS):
                raise AmiwarpError(
                    "--tensor-hz, --tensor-bins, --tensor-out and --tensor-to apply to --tensor; add it, or remove "
                    "them",
                    ErrorCode.OPTIONS,
                )
        elif not has_output:
            raise AmiwarpError(
                "--tensor has no output; give --tensor-out or --tensor-to", ErrorCode.OPTIONS
            )
        elif self.tensor_bins != BINS and self.tensor in ("count", "polarity"):
            raise AmiwarpError(
                f"--tensor-bins applies to voxel and stack; --tensor is {self.tensor}; remove it",
                ErrorCode.OPTIONS,
            )
        # Tensors are larger than a datagram, or a slot of shared memory.
        if self.tensor_to is not None and not self.tensor_to.startswith(("tcp:", "unix:")):
            raise AmiwarpError(
                f"--tensor-to {self.tensor_to} is not possible; give tcp:HOST:PORT or unix:PATH",
                ErrorCode.OPTIONS,
            )

    def build(
        self,
        size: tuple[int, int],
        hello: bytes,
        resources: contextlib.ExitStack,
        *,
        stop: threading.Event,
        say: Callable[[str], None],
    ) -> LiveTensors | None:
        """Open the outputs, which ``resources`` closes, and return what makes the tensors; None without any."""
        if self.tensor is None:
            return None
        from amiwarp.imaging.tensor_stream import TensorStream
        from amiwarp.live.stream.sinks import open_sink
        from amiwarp.live.stream.stream_format import encode_tensor
        from amiwarp.live.stream.tensor_output import TensorOutput

        writer = None
        sink = None
        if self.tensor_out is not None:
            writer = resources.enter_context(TensorWriter(self.tensor_out))
        if self.tensor_to is not None:
            sink = open_sink(self.tensor_to, hello, stop=stop, say=say)
            resources.push(sink)
            say(f"tensors are served at {sink.address}")

        def give(found: StreamTensor) -> None:
            if writer is not None:
                writer.append(found.tensor, found.t_start, found.t_end, found.events)
            if sink is not None:
                sink.send(encode_tensor(found))

        stream = TensorStream(self._representation(size), self.tensor_hz)
        output = resources.enter_context(TensorOutput(stream, give))
        return LiveTensors(output, sink)

    def _representation(self, size: tuple[int, int]) -> ToTensor:
        from amiwarp.imaging import tensors
        from amiwarp.imaging.to_tensor import ToTensor

        width, height = size
        functions: dict[str, Callable[..., Any]] = {
            "voxel": tensors.voxel_grid,
            "count": tensors.event_count,
            "polarity": tensors.polarity_histogram,
            "stack": tensors.stacked_histogram,
        }
        options: dict[str, Any] = {"width": width, "height": height}
        if self.tensor in ("voxel", "stack"):
            options["bins"] = self.tensor_bins
        return ToTensor(functions[str(self.tensor)], **options)


@dataclass(frozen=True)
class LiveTensors:
    """What makes the tensors of a session, with the sink that serves them."""

    output: TensorOutput
    """Taker of the packets of the session."""
    sink: Sink | None
    """Server of the tensors."""

    def tick(self) -> None:
        """Let the server accept receivers, and send what waits for them."""
        if self.sink is not None:
            # An error of an earlier packet comes with the next one, which ends the session in order.
            with contextlib.suppress(Exception):
                self.output.later(self.sink.tick)

    def summary(self) -> dict[str, Any]:
        """Return the counts for ``--json``."""
        return {
            "made": self.output.made,
            "events": self.output.events,
            "dropped_events": self.output.dropped,
            "not_sent": 0 if self.sink is None else self.sink.lost,
        }


def tensor_lines(tensors: dict[str, Any] | None) -> list[str]:
    """Return the line of the result about tensors."""
    if tensors is None:
        return []
    text = f"{tensors['made']:,} tensors of {tensors['events']:,} events"
    if tensors["dropped_events"]:
        text += f", {tensors['dropped_events']:,} events dropped at the end"
    if tensors["not_sent"]:
        text += f", {tensors['not_sent']:,} not sent: a receiver is too slow"
    return [text]
