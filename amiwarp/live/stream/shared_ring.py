"""Ring of packets in shared memory: one program writes, others of the same machine read.

The layout is in ``docs/reference/stream-format.md``. No lock is taken: the writer never waits, and a reader that is
overtaken sees it by the number of the slot. Python has no memory barrier, so a processor that reorders stores, as ARM's
do, may show a number before its packet. The check of the slot and the checksum of the packet then do not fit, and the
reader reads again.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import struct
import threading
import time
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.stream.sockets import Unreachable
from amiwarp.live.stream.stream_format import (
    checksum_fits,
    checksum_of,
    encode_end,
    is_packet,
    split_packets,
)
from amiwarp.workarounds import remove_shared_memory, untracked_shared_memory

MAGIC = b"AMIR"
VERSION = 1
HEAD = struct.Struct("<4sIIIII")
"""Begin of the ring: magic, version, number of slots, size of a slot, size of the hello and place of slot 0 [bytes]."""
RING_ID, NEXT, BEAT = 3, 4, 5
"""Places of the ring's random number, of the next packet's number, and of the count of the writer's beats [8 bytes]."""
HELLO_AT = 64
"""Place of the hello packet [bytes]."""
SLOT_HEAD = 16
"""Size of the head of a slot [bytes]: number of the packet plus 1 (``u64``), its length and its check (``u32``)."""
SLOTS = 384
"""Default number of slots. The default ring has 48 MiB: containers often have 64 MiB of shared memory."""
SLOT_BYTES = 1 << 17
"""Default size of a slot [bytes]: 7,279 compensated events fit. Packets that are cut cost three times the time."""
BEAT_S = 0.2
"""Time between two beats of the writer [s]."""
DEAD_S = 3.0
"""Time without a beat after which a writer counts as dead [s]."""
POLL_S = 0.0005
"""Pause of a reader between two looks for the next packet [s]."""
DAMAGED_S = 1.0
"""Time after which a packet that does not fit its check is damaged, and not still on its way from the writer [s]."""
NAME = re.compile(r"[A-Za-z0-9_.-]{1,30}")
"""Names that all systems take: macOS takes 30 characters."""


def ring_name(address: str) -> str:
    """Return the name in ``shm:NAME``. Raises :class:`AmiwarpError` for a name that some systems refuse."""
    name = address.removeprefix("shm:")
    if not NAME.fullmatch(name):
        raise AmiwarpError(
            f"{address}: is no name of shared memory; give shm: with 1 to 30 letters, digits, '.', '_' or '-'"
        )
    return name


class RingSink:
    """Writer of packets to a ring in shared memory, which never waits for a reader.

    A reader gets ``hello``, and all packets after it began. A reader that falls behind by all ``slots`` loses packets,
    and counts them itself. A background thread beats, so that readers notice if this program dies. Raises
    :class:`AmiwarpError` if another program writes to the ring ``shm:NAME``. A ring whose writer died is replaced.
    """

    def __init__(
        self, address: str, hello: bytes, *, slots: int = SLOTS, slot_bytes: int = SLOT_BYTES
    ) -> None:
        self.address = address
        self.lost = 0
        """Number of lost packets: always 0, because each reader counts what it lost."""
        self._name = ring_name(address)
        self._slots = slots
        self._slot_bytes = slot_bytes
        self._place = -(-(HELLO_AT + len(hello)) // 64) * 64
        self._memory = _create(self._name, self._place + slots * slot_bytes)
        self._bytes = _bytes_of(self._memory)
        self._words = self._bytes.cast("Q")
        self._halves = self._bytes.cast("I")
        self._number = 0
        self._words[RING_ID] = self._ring_id = secrets.randbits(64)
        self._words[BEAT] = 1
        self._bytes[HELLO_AT : HELLO_AT + len(hello)] = hello
        head = HEAD.pack(MAGIC, VERSION, slots, slot_bytes, len(hello), self._place)
        self._bytes[4 : HEAD.size] = head[4:]
        self._bytes[:4] = MAGIC  # last: readers take the ring from now on
        self._ended = threading.Event()
        self._heart = threading.Thread(target=self._beat, name="amiwarp-ring", daemon=True)
        self._heart.start()

    def __enter__(self) -> RingSink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, data: bytes) -> None:
        """Write complete packets, encoded by the ``encode_...`` functions; long ones as several packets."""
        for packet in split_packets(data, self._slot_bytes - SLOT_HEAD):
            self._write(packet)

    def tick(self) -> None:
        """Do nothing, because no packets wait."""

    def close(self) -> None:
        """Write the end message and remove the ring's name. Readers keep the ring until they have read it."""
        if self._ended.is_set():
            return
        self.send(encode_end())
        self._ended.set()
        self._heart.join()
        self._words[BEAT] = 0
        self._words.release()
        self._halves.release()
        self._memory.close()
        _remove(self._name, self._ring_id)

    def _write(self, packet: bytes | memoryview) -> None:
        start = self._place + self._number % self._slots * self._slot_bytes
        after = self._number + 1
        self._words[start // 8] = 0  # a reader that still copies the old packet notices
        self._halves[start // 4 + 2] = len(packet)
        self._halves[start // 4 + 3] = checksum_of(packet) ^ (after & 0xFFFFFFFF)
        self._bytes[start + SLOT_HEAD : start + SLOT_HEAD + len(packet)] = packet
        self._words[start // 8] = after
        self._words[NEXT] = after
        self._number = after

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            self._words[BEAT] += 1


class RingReceiver:
    """Reader of a ring in shared memory, for :class:`~amiwarp.live.stream.stream_source.PacketSource`.

    It begins with the hello and the next packet that the writer writes. If the writer overtakes it, it goes on in the
    middle of the ring and counts what it lost. Raises :class:`Unreachable` if no program writes to the ring.
    """

    def __init__(self, address: str) -> None:
        name = ring_name(address)
        self.lost = 0
        """Number of packets that were overwritten before they were read."""
        self.problem: str | None = None
        """Why no more packets will come, in one line; None while they may."""
        self._address = address
        memory = _attached(name)
        if memory is None:
            raise Unreachable(f"{address}: there is no such shared memory; start its writer first")
        self._memory = memory
        try:
            self._slots, self._slot_bytes, self._place, hello = _read_head(
                address, _bytes_of(self._memory)
            )
        except BaseException:
            self._memory.close()
            raise
        self._hello: bytes | None = hello
        # The memory may be longer, by less than a page.
        size = self._place + self._slots * self._slot_bytes
        self._bytes = _bytes_of(self._memory)[:size].toreadonly()
        self._words = self._bytes.cast("Q")
        self._halves = self._bytes.cast("I")
        self._number = self._words[NEXT]
        self._unfit_since: float | None = None
        if not _lives(self._words):
            self.close()
            raise Unreachable(f"{address}: its writer has ended, or died; start it again")
        self._last_beat = self._words[BEAT]
        self._beat_s = time.monotonic()

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next packet, at first the hello; None if there is none within the timeout."""
        if self._hello is not None:
            hello = self._hello
            self._hello = None
            return hello
        until = time.monotonic() + timeout_s
        while True:
            packet = self._take()
            now = time.monotonic()
            if packet is not None:
                return packet
            self._check_beat(now)
            if self.problem is not None or now >= until:
                return None
            time.sleep(POLL_S)

    def close(self) -> None:
        """Release the memory."""
        self._words.release()
        self._halves.release()
        self._bytes.release()
        self._memory.close()

    def _take(self) -> bytes | None:
        """Return the next packet; None if it is not there yet."""
        ahead = self._words[NEXT] - self._number
        if ahead <= 0:
            return None
        if ahead >= self._slots:  # the writer has begun to overwrite the packet
            skipped = ahead - self._slots // 2
            self.lost += skipped
            self._number += skipped
            self._unfit_since = None
        start = self._place + self._number % self._slots * self._slot_bytes
        after = self._number + 1
        if self._words[start // 8] != after:
            self._note_unfit()
            return None
        length = self._halves[start // 4 + 2]
        check = self._halves[start // 4 + 3]
        packet = bytes(
            self._bytes[start + SLOT_HEAD : start + min(SLOT_HEAD + length, self._slot_bytes)]
        )
        is_whole = is_packet(packet) and self._words[start // 8] == after
        if not (is_whole and checksum_fits(packet, check ^ (after & 0xFFFFFFFF))):
            self._note_unfit()
            return None
        self._unfit_since = None
        self._number = after
        return packet

    def _note_unfit(self) -> None:
        """Note that the packet is not whole: it was just overwritten, or its bytes are still on their way."""
        now = time.monotonic()
        if self._unfit_since is None:
            self._unfit_since = now
        if now - self._unfit_since > DAMAGED_S:
            self.problem = f"packet {self._number} is damaged"

    def _check_beat(self, now_s: float) -> None:
        beat = self._words[BEAT]
        if beat != self._last_beat:
            self._last_beat = beat
            self._beat_s = now_s
        elif now_s - self._beat_s > DEAD_S:
            self.problem = f"its writer has not answered for {DEAD_S:g} s"


def _read_head(address: str, memory: memoryview) -> tuple[int, int, int, bytes]:
    """Return number and size of the slots, place of the first one, and the hello packet of a ring."""
    if len(memory) < HELLO_AT or bytes(memory[: len(MAGIC)]) != MAGIC:
        raise Unreachable(
            f"{address}: holds no ring of amiwarp; start its writer first, or choose another name"
        )
    _, version, slots, slot_bytes, hello_bytes, place = HEAD.unpack_from(memory)
    fits = HELLO_AT + hello_bytes <= place and place + slots * slot_bytes <= len(memory)
    is_aligned = place % 8 == slot_bytes % 8 == 0
    if version != VERSION or not fits or not is_aligned or slots < 2 or slot_bytes <= SLOT_HEAD:
        raise AmiwarpError(
            f"{address}: is of version {version}, with {slots} slots of {slot_bytes} bytes in {len(memory)} bytes; "
            f"expected version {VERSION} and slots that fit; see docs/reference/stream-format.md",
            ErrorCode.FILE_DAMAGED,
        )
    return slots, slot_bytes, place, bytes(memory[HELLO_AT : HELLO_AT + hello_bytes])


def _lives(words: memoryview) -> bool:
    """Return whether a ring's writer beats within :data:`DEAD_S`."""
    beat = words[BEAT]
    until = time.monotonic() + DEAD_S
    while beat and time.monotonic() < until:
        if words[BEAT] != beat:
            return bool(words[BEAT])
        time.sleep(POLL_S)
    return False


def _create(name: str, size: int) -> SharedMemory:
    """Return new shared memory of a name, filled with zeros, and remove what a writer that died left."""
    try:
        with contextlib.suppress(FileExistsError):
            return _reserved(name, size)
        _remove_left_over(name)
        return _reserved(name, size)
    except OSError as error:
        raise AmiwarpError(
            f"shm:{name}: cannot make shared memory of {size:,} bytes: {error.strerror or error}; choose another name, "
            "or free memory (in a container: --shm-size)",
            ErrorCode.OUTPUT_FAILED,
        ) from error


def _reserved(name: str, size: int) -> SharedMemory:
    memory = untracked_shared_memory(name, size)
    path = Path("/dev/shm", name)
    if path.exists() and hasattr(os, "posix_fallocate"):
        # Otherwise a write to a full memory file system would end the program later.
        descriptor = os.open(path, os.O_WRONLY)
        try:
            os.posix_fallocate(descriptor, 0, size)
        except OSError:
            memory.close()
            remove_shared_memory(memory)
            raise
        finally:
            os.close(descriptor)
    return memory


def _remove_left_over(name: str) -> None:
    """Remove the ring of a writer that died. Raises :class:`AmiwarpError` if the memory is used, or no ring."""
    memory = _attached(name)
    if memory is None:
        return
    with contextlib.closing(memory), _bytes_of(memory)[:HELLO_AT] as head:
        if len(head) < HELLO_AT or bytes(head[: len(MAGIC)]) != MAGIC:
            raise AmiwarpError(
                f"shm:{name}: holds something else than a ring of amiwarp; choose another name",
                ErrorCode.UNREACHABLE,
            )
        with head.cast("Q") as words:
            ring_id = words[RING_ID]
            if _lives(words):
                raise AmiwarpError(
                    f"shm:{name}: another program writes to it; choose another name",
                    ErrorCode.UNREACHABLE,
                )
    _remove(name, ring_id)


def _remove(name: str, ring_id: int) -> None:
    """Remove a name, unless another ring has it by now."""
    memory = _attached(name)
    if memory is None:
        return
    with contextlib.closing(memory), _bytes_of(memory)[:HELLO_AT] as head:
        is_same = len(head) == HELLO_AT and head.cast("Q")[RING_ID] == ring_id
    if is_same:
        with contextlib.suppress(FileNotFoundError):
            remove_shared_memory(memory)


def _attached(name: str) -> SharedMemory | None:
    """Return the shared memory of a name; None if there is none, or if it has no size yet."""
    try:
        return untracked_shared_memory(name)
    except (FileNotFoundError, ValueError):
        return None
    except OSError as error:
        raise AmiwarpError(
            f"shm:{name}: cannot open shared memory: {error.strerror or error}; run both programs as the same user",
            ErrorCode.UNREACHABLE,
        ) from error


def _bytes_of(memory: SharedMemory) -> memoryview:
    """Return the bytes of shared memory that is open."""
    assert memory.buf is not None
    return memory.buf
