"""The files for a builder: the same bytes from each build, readable by independent readers, and run as they are."""

import hashlib
import random
import re
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import pytest

from amiwarp.live.link import SetSpeed
from tests.firmware.test_firmware import FIRMWARE, Host, header_is_missing, load, run_make

pytestmark = [
    pytest.mark.skipif(
        not FIRMWARE.is_dir(), reason="the firmware is not in this copy of the project"
    ),
    pytest.mark.skipif(
        shutil.which("arm-none-eabi-gcc") is None
        or header_is_missing(("avr-gcc", "-mmcu=atmega2560"), "avr/io.h"),
        reason="needs arm-none-eabi-gcc (Debian: gcc-arm-none-eabi), avr-gcc (gcc-avr) and avr-libc",
    ),
]
IMAGES = ("amiwarp-avr.hex", "amiwarp-rp2040.uf2")
"""With the default settings."""
PER_RIG = {
    "amiwarp-avr-500-lines.hex": (4000, 1000),
    "amiwarp-avr-hollow-shaft.hex": (8000, 560),
    "amiwarp-rp2040-500-lines.uf2": (4000, 1500),
    "amiwarp-rp2040-magnetic.uf2": (32768, 1500),
}
"""Counts per turn of the prism, and largest speed, of the images for each rig."""
ALL = sorted([*IMAGES, *PER_RIG])


@pytest.fixture(scope="module")
def released(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("first")
    run_make(folder, "release")
    return folder / "release"


@pytest.fixture(scope="module")
def release() -> Any:
    return load("release")


def test_two_builds_are_the_same_bytes(released: Path, tmp_path: Path) -> None:
    again = tmp_path / "another-place" / "with" / "a-longer-name"
    again.mkdir(parents=True)
    run_make(again, "release")
    names = sorted(path.name for path in released.iterdir())
    assert names == ["SHA256SUMS", *ALL, "sizes.txt"]
    for name in names:
        assert (again / "release" / name).read_bytes() == (released / name).read_bytes(), name


@pytest.mark.parametrize("name", PER_RIG)
def test_the_image_of_a_rig_has_its_counts_and_speed(
    released: Path, release: Any, name: str
) -> None:
    """``struct settings`` begins with both, and the file is the one that make built for this encoder."""
    flash = release.read(released / name)
    assert struct.pack("<2i", *PER_RIG[name]) in flash
    for other, numbers in PER_RIG.items():
        if other != name:
            assert (struct.pack("<2i", *numbers) in flash) is (numbers == PER_RIG[name])
    stem = name.removeprefix("amiwarp-").split(".")[0]
    encoder = "MAGNETIC" if "magnetic" in name else "QUADRATURE"
    made = {
        "rp2040": f"prism-{encoder}-PULSES_TIMED.uf2",
        "avr": "prism-atmega2560-PULSES_TIMED.hex",
    }
    built = released.parent / "variants" / stem / made[stem.split("-")[0]]
    assert built.read_bytes() == (released / name).read_bytes()
    assert f"{name}: {len(flash):,} bytes of flash" in (released / "sizes.txt").read_text()


def test_settings_for_a_release_are_refused(tmp_path: Path) -> None:
    make = (
        "make",
        "-s",
        "-C",
        str(FIRMWARE),
        f"BUILD={tmp_path}",
        "release",
        "COUNTS=2000",
        "ENCODER=MAGNETIC",
    )
    done = subprocess.run(make, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "make release builds the settings of each rig: leave out ENCODER COUNTS" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_readme_lists_each_file_with_the_settings_of_make() -> None:
    readme = (FIRMWARE / "README.md").read_text()
    makefile = (FIRMWARE / "Makefile").read_text()
    for name, (counts, rpm) in PER_RIG.items():
        (row,) = (line for line in readme.splitlines() if line.startswith(f"| `{name}`"))
        settings = row.split("|")[3].strip().strip("`")
        board, rig = re.fullmatch(r"amiwarp-(rp2040|avr)-(.*)\.\w+", name).groups()
        assert f"{board}_{rig} := {settings}\n" in makefile
        assert f"MOST_RPM={rpm}" in settings
        assert row.endswith(f"| {counts:,} |")


def test_the_sums_are_those_of_the_files(released: Path) -> None:
    listed = [line.split("  ") for line in (released / "SHA256SUMS").read_text().splitlines()]
    assert [name for _, name in listed] == [*ALL, "sizes.txt"]
    for digest, name in listed:
        assert digest == hashlib.sha256((released / name).read_bytes()).hexdigest()


def test_the_readers_give_what_the_compiler_made(released: Path, release: Any) -> None:
    build = released.parent
    flash = (build / "prism-QUADRATURE-PULSES_TIMED.bin").read_bytes()
    assert release.read(released / IMAGES[1]) == flash.ljust(-(-len(flash) // 256) * 256, b"\0")
    run_make(build, "avr")
    program = build / "avr.bin"
    elf = build / "prism-atmega2560-PULSES_TIMED.elf"
    subprocess.run(["avr-objcopy", "-O", "binary", elf, program], check=True)
    assert release.read(released / IMAGES[0]) == program.read_bytes()
    sizes = (released / "sizes.txt").read_text()
    assert f"{IMAGES[0]}: {program.stat().st_size:,} bytes of flash" in sizes
    assert "prism-QUADRATURE-PULSES_TIMED.elf" in sizes


def test_the_crc_of_the_boot_stage_is_the_one_of_the_rom(release: Any) -> None:
    assert release.boot_crc(b"123456789") == 0x0376E6E7  # the check value of CRC-32/MPEG-2


def uf2_changed(released: Path, where: int, value: bytes) -> bytes:
    data = bytearray((released / IMAGES[1]).read_bytes())
    data[where : where + len(value)] = value
    return bytes(data)


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [
        (0, b"x", "block 0: no UF2 block"),
        (512 + 508, b"x", "block 1: no UF2 block"),
        (8, struct.pack("<I", 0), "are not those of an RP2040"),
        (28, struct.pack("<I", 1), "family 0x1 are not"),
        (512 + 12, struct.pack("<I", 0x10000200), "0x10000200 does not follow 0x10000100"),
        (12, struct.pack("<I", 0x10000104), "the ROM writes pages of 256 bytes"),
        (16, struct.pack("<I", 255), "the ROM writes pages of 256 bytes"),
        (512 + 20, struct.pack("<I", 2), "block 1: says that it is 2 of"),
        (24, struct.pack("<I", 3), "is 0 of 3"),
        (32 + 9, b"\xa5", "CRC of the boot stage"),
        (32 + 253, b"\xa5", "CRC of the boot stage"),
    ],
)
def test_a_wrong_uf2_is_named(
    released: Path, release: Any, where: int, value: bytes, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        release.read_uf2(uf2_changed(released, where, value))


def test_a_cut_uf2_and_one_at_another_address_are_named(released: Path, release: Any) -> None:
    data = (released / IMAGES[1]).read_bytes()
    with pytest.raises(ValueError, match="no whole number of blocks"):
        release.read_uf2(data[:-1])
    with pytest.raises(ValueError, match="says that it is 0 of"):
        release.read_uf2(data[:-512])
    moved = bytearray(data)
    for block in range(0, len(data), 512):
        struct.pack_into(
            "<I", moved, block + 12, struct.unpack_from("<I", data, block + 12)[0] + 256
        )
    with pytest.raises(ValueError, match="begins at 0x10000100"):
        release.read_uf2(bytes(moved))


def test_a_wrong_hex_is_named(released: Path, release: Any) -> None:
    text = (released / IMAGES[0]).read_text()
    lines = text.splitlines()
    rng = random.Random(0)
    for _ in range(50):  # any digit that changes
        at = rng.randrange(len(lines) - 1)
        column = rng.randrange(1, len(lines[at]))
        other = rng.choice([digit for digit in "0123456789ABCDEF" if digit != lines[at][column]])
        changed = [
            *lines[:at],
            lines[at][:column] + other + lines[at][column + 1 :],
            *lines[at + 1 :],
        ]
        with pytest.raises(ValueError, match=f"line {at + 1}:"):
            release.read_hex("\n".join(changed))
    for wrong, said in (
        (lines[:-1], "the last line is not the end"),
        ([*lines, lines[0]], "the last line is not the end"),
        (lines[1:], "begins at 0x10"),
        ([*lines[:3], *lines[4:]], "0x40 does not follow 0x30"),
        (["x", *lines], "line 1: does not begin with"),
        ([":00000006FA", *lines], "unknown record of type 6"),
    ):
        with pytest.raises(ValueError, match=said):
            release.read_hex("\n".join(wrong))


def test_addresses_beyond_64_kilobytes_are_read(release: Any) -> None:
    def record(address: int, kind: int, payload: bytes) -> str:
        body = bytes([len(payload), address >> 8, address & 255, kind]) + payload
        return ":" + (body + bytes([-sum(body) & 255])).hex().upper()

    first = [record(a, 0, bytes([a >> 12]) * 128) for a in range(0, 1 << 16, 128)]
    for upper in (record(0, 2, b"\x10\x00"), record(0, 4, b"\x00\x01")):
        text = "\n".join([*first, upper, record(0, 0, b"end"), record(0, 1, b"")])
        flash = release.read_hex(text)
        assert (len(flash), flash[-3:], flash[0x1000]) == (65_539, b"end", 1)


def test_a_released_file_runs_as_it_is(released: Path) -> None:
    boards = load("boards")
    missing_node = (
        shutil.which("node") is None
        or not (FIRMWARE / "simulator" / "node_modules" / "rp2040js").is_dir()
    )
    missing_simavr = header_is_missing(("gcc",), "simavr/sim_avr.h")
    if missing_node or missing_simavr:
        pytest.skip(
            "needs Node.js with rp2040js (npm install --prefix firmware/simulator), and simavr (libsimavr-dev)"
        )
    run_make(released.parent, f"{released.parent}/libavr.so")
    for board in (
        boards.SimulatedBoard(released / IMAGES[1]),
        boards.AvrBoard(released / IMAGES[0], library=released.parent / "libavr.so"),
    ):
        host = Host(board)
        host.run(0.05)
        assert host.command(SetSpeed(300.0, 4000.0)) == 0
        host.run(0.5)
        assert (host.status.state, host.status.target_rpm, host.status.faults) == (1, 300.0, 0)
        board.reset()
        host.run(0.1)
        assert host.decoder.received.restarts == 1
        board.close()
