"""Names of files that are no recordings, by their first bytes, and what to do with them."""

from __future__ import annotations

TABLE = "save x, y, t [us] and p from it as .npz"
VIDEO = "make events of it with amiwarp translate"
PICTURE = "make events of it with amiwarp simulate --picture"
JSON = "give a recording; a calibration goes to --calibration, a camera to --camera"
CAPTURE = "give the events as the camera's software saves them"
UNPACK = "unpack it first"
PICKLE = f"{TABLE}; pickles are never loaded"

MISTAKEN_FILES: tuple[tuple[int, bytes, str, str], ...] = (
    # position, bytes, what the file is, what to do
    (0, b"\x89PNG\r\n\x1a\n", "a PNG picture", PICTURE),
    (0, b"\xff\xd8\xff", "a JPEG picture", PICTURE),
    (0, b"GIF8", "a GIF picture", PICTURE),
    (0, b"BM", "a BMP picture", PICTURE),
    (0, b"II*\0", "a TIFF picture", PICTURE),
    (0, b"MM\0*", "a TIFF picture", PICTURE),
    (8, b"WEBP", "a WebP picture", PICTURE),
    (4, b"ftypavif", "an AVIF picture", PICTURE),
    (4, b"ftyphei", "a HEIC picture", PICTURE),
    (4, b"ftypmif1", "a HEIF picture", PICTURE),
    # All other files of ISO's container are taken for videos, most of which they are.
    (4, b"ftyp", "an MP4 video", VIDEO),
    (8, b"AVI ", "an AVI video", VIDEO),
    (0, b"\x1aE\xdf\xa3", "a Matroska or WebM video", VIDEO),
    (0, b"\x1f\x8b", "a gzip archive", UNPACK),
    (0, b"BZh", "a bzip2 archive", UNPACK),
    (0, b"\xfd7zXZ\0", "an xz archive", UNPACK),
    (0, b"\x28\xb5\x2f\xfd", "a Zstandard archive", UNPACK),
    (0, b"\x04\x22\x4d\x18", "an LZ4 archive", UNPACK),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", UNPACK),
    (0, b"Rar!\x1a\x07", "a RAR archive", UNPACK),
    (257, b"ustar", "a tar archive", UNPACK),
    (0, b"\xd4\xc3\xb2\xa1", "a pcap capture of network packets", CAPTURE),
    (0, b"\xa1\xb2\xc3\xd4", "a pcap capture of network packets", CAPTURE),
    (0, b"\xa1\xb2\x3c\x4d", "a pcap capture of network packets", CAPTURE),
    (0, b"\x4d\x3c\xb2\xa1", "a pcap capture of network packets", CAPTURE),
    (0, b"\n\r\r\n", "a pcapng capture of network packets", CAPTURE),
    (0, b"ARROW1", "an Arrow table", TABLE),
    (0, b"\x80\x04\x95", "a Python pickle", PICKLE),
    (0, b"\x80\x05\x95", "a Python pickle", PICKLE),
    (0, b"#ROSBAG V1", "a ROS 1 bag of version 1", "run rosbag migrate and rosbag reindex"),
    (0, b"%PDF", "a PDF document", "give a recording"),
    (0, b"\x7fELF", "a program", "give a recording"),
    (0, b"<?xml", "an XML document", "give a recording"),
    (0, b"{", "a JSON document", JSON),
    (0, b"RIFF", "a RIFF file of sound or pictures", "give a recording"),
)
"""Files that are often mistaken for recordings."""


def what_it_is(head: bytes) -> str | None:
    """Return what a file is and what to do with it, from its first bytes, or None if it is unknown."""
    for offset, magic, what, remedy in MISTAKEN_FILES:
        if head[offset : offset + len(magic)] == magic:
            return f"is {what}; {remedy}"
    return None
