"""The RP2040's own USB as a serial port; ``firmware/simulator/usb.mjs``, the simulated host, checks each packet."""

import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from amiwarp.live.link import (
    ControllerStatus,
    FrameDecoder,
    Ping,
    Pong,
    Samples,
    SetSpeed,
    Stop,
    check_controller,
    encode,
)
from tests.firmware import test_firmware as base
from tests.firmware.test_firmware import FIRMWARE, Host, load, of
from tests.live.test_conformance import VirtualWire

pytestmark = [
    pytest.mark.skipif(
        not FIRMWARE.is_dir(), reason="the firmware is not in this copy of the project"
    ),
    pytest.mark.skipif(
        shutil.which("gcc") is None or shutil.which("make") is None, reason="needs gcc and make"
    ),
]
images = base.images
ENUMERATION_S = 0.3
"""Longest time in which the simulated host enumerates the device and opens its port [s]."""


@pytest.fixture
def start(images: Callable[..., Path]) -> Iterator[Callable[..., Any]]:
    """Start the chip with a USB host; ``uart``: the link of the board is its UART."""
    started = []

    def board(*, uart: bool = False) -> Any:
        image, boards = images("QUADRATURE", "PULSES_TIMED"), load("boards")
        started.append(boards.SimulatedBoard(image, usb=True) if uart else boards.UsbBoard(image))
        return started[-1]

    yield board
    for one in started:
        one.close()


@pytest.fixture
def host(start: Callable[..., Any]) -> Host:
    host = Host(start())
    host.run(ENUMERATION_S)
    return host


def problems(host: Host) -> list[str]:
    found: list[str] = host.board.get("usb")["problems"]
    return found


def test_the_device_is_enumerated_as_a_serial_port(host: Host) -> None:
    found = host.board.get("usb")
    assert found["problems"] == []
    assert found["open"] is True
    assert found["strings"] == ["amiwarp", "prism controller"]
    device, configuration = found["device"], found["configuration"]
    assert device[2:4] == [0, 2]  # USB 2.0
    assert device[4:7] == [0xEF, 2, 1]  # functions of several interfaces
    assert device[17] == 1  # configuration
    parts, at = [], 0
    while at < len(configuration):
        assert configuration[at] >= 2
        parts.append(configuration[at : at + configuration[at]])
        at += configuration[at]
    assert at == len(configuration) == configuration[2] | configuration[3] << 8
    assert parts[0][7] & 0x80  # supplied by the bus
    assert parts[0][4] == 2
    functions = [part[3:7] for part in parts if part[1] == 11]
    # Two interfaces from 0 on: communication, abstract control model
    assert functions == [[2, 2, 2, 0]]
    interfaces = [(part[2], part[4], part[5], part[6]) for part in parts if part[1] == 4]
    assert interfaces == [(0, 1, 2, 2), (1, 2, 10, 0)]
    endpoints = [(part[2], part[3], part[4] | part[5] << 8) for part in parts if part[1] == 5]
    assert endpoints == [(0x81, 3, 8), (0x02, 2, 64), (0x82, 2, 64)]
    # Header, calls, abstract control, union
    assert {part[2] for part in parts if part[1] == 0x24} == {
        0,
        1,
        2,
        6,
    }
    assert next(part[3:] for part in parts if part[1:3] == [0x24, 6]) == [0, 1]


def test_frames_over_usb_turn_the_motor(host: Host) -> None:
    assert host.command(SetSpeed(400.0, 4000.0)) == 0
    host.run(0.6)
    assert (host.status.state, host.status.target_rpm, host.status.faults) == (1, 400.0, 0)
    times = [t for m in of(Samples, host.messages) for t in m.t_us]
    assert max(b - a for a, b in itertools.pairwise(times)) < 1100
    pongs = of(Pong, host.run(0.5))
    assert len(pongs) == 5
    assert (
        host.decoder.received.damaged
        == host.decoder.received.lost
        == host.decoder.received.unknown
        == 0
    )
    assert host.command(Stop()) == 0
    assert problems(host) == []


def test_the_image_passes_the_conformance_suite_over_usb(start: Callable[..., Any]) -> None:
    board = start()
    checks = check_controller(VirtualWire(board), 240.0)
    assert [check.name for check in checks if not check.passed] == []
    assert board.get("usb")["problems"] == []


def test_many_bytes_at_once_are_taken_one_packet_after_the_other(host: Host) -> None:
    """700 bytes: more than the controller's buffer, which the host may not overrun."""
    pings = b"".join(encode(Ping(number), number) for number in range(50))
    assert len(pings) >= 700
    host.board.feed(pings, host.board.now)
    answered = [m.number for m in of(Pong, host.run(0.09))]
    answered = [number for number in answered if number < 50]  # without the pong of a ping before
    assert answered == list(range(50))
    assert problems(host) == []


def test_the_link_that_speaks_first_is_the_one(start: Callable[..., Any]) -> None:
    """Both hear the controller until then. Here it is the UART, and what comes over USB is not heard any more."""
    host = Host(start(uart=True))
    decoder = FrameDecoder()
    end = host.board.now + round(ENUMERATION_S * 1e6)
    while host.board.now < end:  # in silence
        host.messages += [
            m for _, m in host.decoder.feed(host.board.advance(host.board.now + 5000))
        ]
    over_usb = [m for _, m in decoder.feed(host.board.usb())]
    assert of(ControllerStatus, over_usb)
    assert of(ControllerStatus, host.messages)
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    host.board.usb()
    host.board.usb(encode(Stop(), 9) + encode(Ping(7), 10))
    host.run(0.3)
    assert (host.status.target_rpm, host.status.faults) == (300.0, 0)
    assert host.board.usb() == b""
    assert problems(host) == []


def test_the_uart_is_not_heard_once_usb_is_the_link(host: Host) -> None:
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    uart = load("boards").SimulatedBoard
    uart.feed(host.board, encode(Stop(), 9), host.board.now)
    host.run(0.3)
    assert (host.status.target_rpm, host.status.faults) == (300.0, 0)


def test_damaged_bytes_do_not_choose_the_link(start: Callable[..., Any]) -> None:
    """Noise on an open UART must not lock the USB out."""
    board = start()
    uart = load("boards").SimulatedBoard
    uart.feed(board, bytes(range(1, 200)) + b"\0", board.now)
    host = Host(board)
    host.run(ENUMERATION_S)
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    assert problems(host) == []


def test_a_closed_port_loses_frames_and_the_controller_goes_on(host: Host) -> None:
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    host.run(0.3)
    host.board.usb("close")
    host.board.advance(host.board.now + 300_000)
    assert host.board.advance(host.board.now + 300_000) == b""
    host.board.usb("open")
    host.run(0.3)
    assert (host.status.state, host.status.target_rpm, host.status.faults) == (1, 300.0, 0)
    assert host.decoder.received.lost > 50
    assert host.decoder.received.damaged <= 1  # the frame that the closing cut
    assert host.decoder.received.restarts == 0
    assert problems(host) == []


def test_a_reset_of_the_bus_is_a_new_beginning(host: Host) -> None:
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    host.run(0.3)
    host.board.usb("reset")
    host.run(ENUMERATION_S)
    host.run(0.2)
    assert (host.status.state, host.status.target_rpm) == (1, 300.0)
    assert host.command(Stop()) == 0
    assert problems(host) == []


def test_a_reset_of_the_chip_is_a_new_beginning(host: Host) -> None:
    assert host.command(SetSpeed(300.0, 4000.0)) == 0
    host.board.reset()
    host.run(ENUMERATION_S + 0.2)
    assert (host.decoder.received.restarts, host.status.target_rpm) == (1, 0.0)
    assert host.command(SetSpeed(200.0, 4000.0)) == 0
    assert problems(host) == []
