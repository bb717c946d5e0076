"""The files for a builder: ``python release.py FOLDER`` reads its images back, writes ``SHA256SUMS``, ``sizes.txt``.

The readers are written from the formats' public descriptions and share no code with what wrote the files, so that a
wrong block, address or checksum is found here and not on the desk. ``boards.py`` reads images by them, too.
"""

from __future__ import annotations

import hashlib
import struct
import sys
import zlib
from pathlib import Path

FLASH, BOOT_BYTES = 0x10000000, 256
"""Address of the RP2040's flash, and size of its boot stage with the CRC [bytes]."""
UF2_BLOCK = struct.Struct("<8I476sI")
UF2_MAGIC = 0x0A324655, 0x9E5D5157, 0x0AB16F30
UF2_FAMILY_PRESENT, UF2_RP2040 = 0x2000, 0xE48BFF56
HEX_DATA, HEX_END, HEX_SEGMENT, HEX_LINEAR = 0x00, 0x01, 0x02, 0x04
"""Types of the records of an Intel HEX file: data, end, and the upper part of the addresses that follow, times 16 or
65,536."""


def joined(parts: dict[int, bytes], what: str) -> bytes:
    """Return parts, by address, as one run of bytes; raise ValueError if they overlap or leave a gap."""
    out = b""
    first = min(parts)
    for address in sorted(parts):
        if address != first + len(out):
            raise ValueError(f"{what}: {address:#x} does not follow {first + len(out):#x}")
        out += parts[address]
    return out


def read_uf2(data: bytes) -> bytes:
    """Return the content of the flash from its first byte; raise ValueError if anything in the file is wrong."""
    if not data or len(data) % UF2_BLOCK.size:
        raise ValueError(f"{len(data)} bytes are no whole number of blocks of {UF2_BLOCK.size}")
    parts = {}
    for number, fields in enumerate(UF2_BLOCK.iter_unpack(data)):
        first, second, flags, address, size, block, blocks, family, payload, last = fields
        if (first, second, last) != UF2_MAGIC:
            raise ValueError(f"block {number}: no UF2 block")
        if (flags, family) != (UF2_FAMILY_PRESENT, UF2_RP2040):
            raise ValueError(
                f"block {number}: flags {flags:#x} and family {family:#x} are not those of an RP2040"
            )
        if (block, blocks) != (number, len(data) // UF2_BLOCK.size):
            raise ValueError(f"block {number}: says that it is {block} of {blocks}")
        if size != BOOT_BYTES or address % BOOT_BYTES:
            raise ValueError(
                f"block {number}: the ROM writes pages of 256 bytes, not {size} at {address:#x}"
            )
        parts[address] = payload[:size]
    if min(parts) != FLASH:
        raise ValueError(f"begins at {min(parts):#x}, not at the flash's {FLASH:#x}")
    image = joined(parts, "UF2")
    boot, crc = image[: BOOT_BYTES - 4], image[BOOT_BYTES - 4 : BOOT_BYTES]
    if struct.unpack("<I", crc)[0] != boot_crc(boot):
        raise ValueError("the CRC of the boot stage is wrong: the ROM would not start it")
    return image


def reversed_bits(value: int, bits: int) -> int:
    """Return a number with its bits in the opposite order."""
    return int(f"{value:0{bits}b}"[::-1], 2)


def boot_crc(boot: bytes) -> int:
    """Return the CRC that the RP2040's ROM checks: the one of zlib on reversed bits, without its final inversion."""
    mirrored = zlib.crc32(bytes(reversed_bits(byte, 8) for byte in boot))
    return reversed_bits(mirrored ^ 0xFFFFFFFF, 32)


def read_hex(text: str) -> bytes:
    """Return the content of the flash from address 0; raise ValueError if anything in the file is wrong."""
    parts: dict[int, bytes] = {}
    upper = 0
    lines = text.splitlines()
    for number, line in enumerate(lines, 1):
        if not line.startswith(":"):
            raise ValueError(f"line {number}: does not begin with ':'")
        record = bytes.fromhex(line[1:])
        if len(record) < 5 or record[0] != len(record) - 5 or sum(record) % 256:
            raise ValueError(f"line {number}: its length or its checksum is wrong")
        address, kind, payload = int.from_bytes(record[1:3], "big"), record[3], record[4:-1]
        if kind == HEX_DATA:
            parts[upper + address] = payload
        elif kind == HEX_SEGMENT:
            upper = int.from_bytes(payload, "big") * 16
        elif kind == HEX_LINEAR:
            upper = int.from_bytes(payload, "big") << 16
        elif kind == HEX_END:
            break
        elif kind != 0x03:  # 3: where to start, which an AVR does not use
            raise ValueError(f"line {number}: unknown record of type {kind}")
    if number != len(lines) or kind != HEX_END:
        raise ValueError(
            "the last line is not the end of the file: it was cut, or goes on after it"
        )
    if min(parts) != 0:
        raise ValueError(f"begins at {min(parts):#x}, not at the reset's 0")
    return joined(parts, "HEX")


def read(path: Path) -> bytes:
    """Return the content of the flash in a ``.uf2`` or ``.hex``; raise ValueError, with its name, for a wrong one."""
    try:
        return (
            read_uf2(path.read_bytes())
            if path.suffix == ".uf2"
            else read_hex(path.read_text("ascii"))
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def main(folder: Path) -> None:
    """Check the images in a folder, write the sizes and the checksums, and print both."""
    images = sorted([*folder.glob("*.uf2"), *folder.glob("*.hex")])
    sizes = "".join(f"{path.name}: {len(read(path)):,} bytes of flash\n" for path in images)
    listed = folder / "sizes.txt"
    listed.write_text(
        sizes + "".join(f"\n{path.read_text()}" for path in sorted(folder.glob("*.size")))
    )
    for path in folder.glob("*.size"):
        path.unlink()
    sums = "".join(
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n"
        for path in [*images, listed]
    )
    (folder / "SHA256SUMS").write_text(sums)
    print(f"{folder}:\n{sizes}{sums}", end="")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
