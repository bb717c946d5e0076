"""What a live session makes in the background, as an iterator for programs."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Generic, TypeVar

from amiwarp.compensation.recordings import check_size
from amiwarp.compensation.streams import Compensated
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.link.link import Link
from amiwarp.live.stream.encoder_feed import encoder_count
from amiwarp.live.stream.packets import Source
from amiwarp.live.stream.session import Session
from amiwarp.live.stream.session_status import StageStatus
from amiwarp.live.stream.sources import open_source
from amiwarp.results.calibration import Calibration
from amiwarp.tasks import BackgroundLoop
from amiwarp.validation import real

Item = TypeVar("Item")
"""Compensated packet, or picture."""
MOST_ITEMS = 8
"""Largest number of items that wait for the program. Compensated packets have at most one batch of the compensator."""
STEP_S = 0.1
"""Time between two checks whether the iteration was ended [s]."""


def open_rig(
    resources: contextlib.ExitStack,
    source: str | Path,
    calibration: Calibration,
    *,
    port: str | None,
    counts_per_turn: int | None,
    fast: bool,
    wait_for_source_s: float,
    say: Callable[[str], None],
) -> tuple[Source, Link | None]:
    """Open a source, and the link to the controller, which ``resources`` close. A session closes the source.

    Raises :class:`AmiwarpError` if one cannot be opened, no encoder samples can come, or the calibration belongs to
    another sensor size.
    """
    wait_s = real(wait_for_source_s, "wait_for_source_s", 0.0, 1e9, " s")
    if counts_per_turn is not None and port is None:
        raise AmiwarpError(
            "counts_per_turn is given without port; give the controller's port, or leave it out",
            ErrorCode.OPTIONS,
        )
    link = None
    if port is not None:
        link = resources.enter_context(
            Link(None if port == "find" else port, counts_per_turn=counts_per_turn)
        )
    opened = open_source(os.fspath(source), pace=None if fast else 1.0, wait_s=wait_s, say=say)
    with closed_on_error(opened):
        if not encoder_count(opened, link):
            raise AmiwarpError(
                f"{opened.name}: contains no encoder samples; give the controller's port",
                ErrorCode.CONTENT_MISSING,
            )
        check_size(calibration, opened.size, opened.name)
    return opened, link


@contextlib.contextmanager
def closed_on_error(source: Source) -> Iterator[None]:
    """Close a source if the ``with`` block, in which it gets its session, fails."""
    try:
        yield
    except BaseException:
        source.close()
        raise


class LiveItems(BackgroundLoop, Generic[Item]):
    """Iterator over what a session makes, which runs in a background thread."""

    def __init__(self, source: Source) -> None:
        self.size = source.size
        """Sensor size (width, height) [px]."""
        self._source = source
        self._stop = threading.Event()
        self._items: queue.Queue[Item | None] = queue.Queue(MOST_ITEMS)

    def start(self, session: Session, finish: Callable[[], None] = lambda: None) -> None:
        """Start the session, one of whose consumers calls :meth:`put`. ``finish`` is called after its end."""
        self._session = session
        self._finish = finish
        self._start_thread("amiwarp-live")

    def put(self, item: Item | None) -> None:
        """Wait until there is room for an item, and add it; None marks the end. Does nothing once closed."""
        while not self._ended.is_set():
            with contextlib.suppress(queue.Full):
                self._items.put(item, timeout=STEP_S)
                return

    def close(self) -> None:
        """End the session, drop the waiting items, and wait for its threads. Raises its error, once."""
        self._stop.set()
        super().close()

    def __iter__(self) -> Iterator[Item]:
        return self

    def __next__(self) -> Item:
        while not self._ended.is_set():
            with contextlib.suppress(queue.Empty):
                item = self._items.get(timeout=STEP_S)
                if item is not None:
                    return item
                self.close()
        raise StopIteration

    def _run(self) -> None:
        try:
            status = self._session.run(self._stop, lambda _: None)
            self._finish()
            problem = getattr(self._source, "problem", None)
            if problem is not None:
                raise AmiwarpError(
                    f"{self._source.name}: the stream broke off: {problem}; the iterator gave the {status.events:,} "
                    "events received until then",
                    ErrorCode.UNREACHABLE,
                )
        finally:
            self.put(None)


class LivePackets(LiveItems[Compensated]):
    """Iterator over the packets of a live stream after its last stage, as :class:`Compensated`.

    Parameters
    ----------
    source : Any
        What :func:`stream_live` opens.

    Examples
    --------
    >>> with amiwarp.stream_live("camera:") as packets:  # doctest: +SKIP
    ...     width, height = packets.size
    ...     first = next(packets)
    """

    def __init__(self, source: Any) -> None:  # users get it from stream_live, and make none
        super().__init__(source)

    @property
    def stages(self) -> tuple[StageStatus, ...]:
        """Counts and latency of each stage, from "read" on, a fifth of a second old at most. Final after the end."""
        return tuple(self._session.status.stages)
