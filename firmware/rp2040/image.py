"""Join boot stage and program to a UF2 file for the Pico's USB drive, and to a flash image for the simulator.

``python image.py boot2.bin program.bin out`` writes ``out.uf2`` and ``out.bin``.
"""

import struct
import sys
from pathlib import Path

FLASH, FAMILY, BLOCK = 0x10000000, 0xE48BFF56, 256


def boot_crc(data: bytes) -> int:
    """Return the ROM's CRC-32 of the boot stage: polynomial 0x04C11DB7, not reflected, not inverted at the end."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ (0x04C11DB7 if crc & 0x80000000 else 0)) & 0xFFFFFFFF
    return crc


def image(boot: bytes, program: bytes) -> bytes:
    """Return the content of the flash, from its first byte."""
    if len(boot) > 252:
        sys.exit(f"the boot stage has {len(boot)} bytes, the ROM takes 252")
    boot = boot.ljust(252, b"\0")
    return boot + struct.pack("<I", boot_crc(boot)) + program


def uf2(data: bytes) -> bytes:
    """Return the image as UF2 blocks of 256 bytes."""
    blocks = [data[k : k + BLOCK].ljust(BLOCK, b"\0") for k in range(0, len(data), BLOCK)]
    head = (0x0A324655, 0x9E5D5157, 0x2000)
    return b"".join(
        struct.pack("<8I", *head, FLASH + BLOCK * k, BLOCK, k, len(blocks), FAMILY)
        + block.ljust(476, b"\0")
        + struct.pack("<I", 0x0AB16F30)
        for k, block in enumerate(blocks)
    )


if __name__ == "__main__":
    boot_file, program_file, out = map(Path, sys.argv[1:])
    flash = image(boot_file.read_bytes(), program_file.read_bytes())
    out.with_suffix(".bin").write_bytes(flash)
    out.with_suffix(".uf2").write_bytes(uf2(flash))
