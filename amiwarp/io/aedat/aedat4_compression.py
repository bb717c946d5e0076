"""Compression of the packets in AEDAT 4 files: LZ4 or Zstandard, which is undone within a limit of the memory."""

import enum
from typing import Any

LARGEST_FRAME = 1 << 24
"""Content of a small packet up to which Zstandard is undone [bytes]: a black frame gains any factor."""
LARGEST_PACKET = 1 << 28
"""Largest packet that is read, before and after its compression is undone [bytes]."""
PART_BYTES = 1 << 21
"""Size of the parts in which Zstandard is undone if the packet does not state its size [bytes]."""


class Compression(enum.StrEnum):
    """Compression of the packets, in the order of the numbers that the header stores."""

    NONE = "none"
    LZ4 = "lz4"
    LZ4_HIGH = "lz4_high"
    ZSTD = "zstd"
    ZSTD_HIGH = "zstd_high"


LZ4_MARK = b"\x04\x22\x4d\x18"
ZSTD_MARK = b"\x28\xb5\x2f\xfd"
FRAME_MARKS = {
    Compression.LZ4: LZ4_MARK,
    Compression.LZ4_HIGH: LZ4_MARK,
    Compression.ZSTD: ZSTD_MARK,
    Compression.ZSTD_HIGH: ZSTD_MARK,
}
"""First bytes of the packets that are compressed."""


class Decompressor:
    """Undoes the compression of packets, within a limit of their size."""

    def __init__(self, compression: Compression) -> None:
        self._compression = compression
        self._lz4: Any = None

    def __call__(self, data: bytes | memoryview) -> bytes | None:
        """Return the content of a packet, or None if it is damaged or too large."""
        if self._compression is Compression.NONE:
            return bytes(data)
        if self._compression in (Compression.ZSTD, Compression.ZSTD_HIGH):
            return _undo_zstd(data, min(LARGEST_PACKET, 256 * len(data) + LARGEST_FRAME))
        # More than LZ4 can gain. Events of a camera gain a twentieth of it.
        most = min(LARGEST_PACKET, 256 * len(data) + (1 << 16))
        try:
            content = self._undo_lz4(data, most)
        except (RuntimeError, MemoryError):
            content = None
        if content is None:
            # The state belongs to an unfinished packet.
            self._lz4 = None
        return content

    def _undo_lz4(self, data: bytes | memoryview, most: int) -> bytes | None:
        import lz4.frame

        if self._lz4 is None:
            self._lz4 = lz4.frame.create_decompression_context()
        # Most packets need one call. Memory for the largest packet would be taken and given back for each.
        capacity = min(most, 8 * len(data))
        content, used, is_whole = lz4.frame.decompress_chunk(self._lz4, data, max_length=capacity)
        parts = [content]
        size = len(content)
        while not is_whole and size < most:
            data = data[used:]
            capacity = most - size
            content, used, is_whole = lz4.frame.decompress_chunk(
                self._lz4, data, max_length=capacity
            )
            if not content and not used:
                return None
            parts.append(content)
            size += len(content)
        return b"".join(parts) if is_whole else None


def _undo_zstd(data: bytes | memoryview, most: int) -> bytes | None:
    """Return what Zstandard has compressed, or None if it is damaged or has more than ``most`` bytes."""
    import zstandard

    try:
        stated = zstandard.frame_content_size(data)
        decompressor = zstandard.ZstdDecompressor(max_window_size=LARGEST_PACKET)
        if stated > most:
            return None
        if stated >= 0:
            return bytes(decompressor.decompress(data, max_output_size=most))
        parts: list[bytes] = []
        with decompressor.stream_reader(data) as reader:
            while part := reader.read(PART_BYTES):
                parts.append(part)
                if sum(map(len, parts)) > most:
                    return None
        return b"".join(parts)
    except (zstandard.ZstdError, MemoryError):
        return None


def compressed(content: bytes) -> bytes:
    """Return a packet that is compressed by LZ4, as the header of a written file states."""
    import lz4.frame

    return bytes(lz4.frame.compress(content, store_size=False))
