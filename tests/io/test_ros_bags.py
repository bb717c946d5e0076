"""Bags as drivers and recorders write them: lost packets, long pauses, both orders of EVT 2.1, compressed files."""

import errno
import gc
import os
import re
import struct
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from amiwarp import (
    AmiwarpError,
    ErrorCode,
    Events,
    MemoryEvents,
    Recording,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.io import read_encoder_triggers
from amiwarp.io.prophesee.evt_words import Halves, halves_of, words_of
from amiwarp.io.ros import bags as ros_bags
from amiwarp.io.ros import packed as ros_packed
from amiwarp.io.ros.bags import Message
from amiwarp.io.ros.messages import decode_array
from amiwarp.io.ros.order import (
    AHEAD,
    FIRST_NUMBERS,
    LATE,
    RESTART,
    MessageNumbers,
    Numbered,
    number_of,
)
from amiwarp.io.ros.reading import Unknown
from amiwarp.io.ros.words import Layout
from reference.evt_words import Evt2Decoder, Evt3Decoder, swap_halves
from reference.io_samples import make_events, refusal
from reference.io_samples_extra import (
    SIZE,
    array_message,
    arrays,
    evt2_words,
    packet_message,
    packets,
    typestore,
    write_ros1,
    write_ros2,
)
from tests.io.test_evt_decoder import random_words
from tests.io.test_io_readers import assert_equal
from tests.io.test_io_sensors import image_message

EVENTS = make_events()
SECOND = 1_000_000_000
PERIOD = 1 << 24
"""Time after which the clock of EVT 3.0 wraps [us]."""

HIGH, LOW, ROW, ON, BASE = 0x8000, 0x6000, 0x0000, 0x2800, 0x3800


def message(
    words: Any,
    seq: int = 0,
    stamp: float = 0.0,
    *,
    encoding: str = "evt3",
    ros1: bool = False,
    base: int = 0,
) -> Any:
    """Return a packet of words. ``stamp`` [s]."""
    dtype = {"evt3": "<u2", "evt2": "<u4", "evt21": "<u8"}.get(encoding)
    made = packet_message(typestore(ros1), encoding, np.array(words, dtype), base, ros1=ros1)
    made.seq = seq
    nanoseconds = round(stamp * SECOND)
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(nanoseconds, SECOND)
    return made


def one_event(t: int, x: int = 5, y: int = 7) -> list[int]:
    """Return the words of an event in EVT 3.0."""
    return [HIGH | t >> 12 & 0xFFF, LOW | t & 0xFFF, ROW | y, ON | x]


def bag(tmp_path: Path, messages: list[Any], *, ros1: bool = False, name: str = "a") -> Path:
    """Write messages into a bag."""
    if not ros1:
        return write_ros2(tmp_path / name, {"/events": messages})
    write_ros1(tmp_path / f"{name}.bag", {"/events": messages})
    return tmp_path / f"{name}.bag"


def rows(path: Path) -> tuple[list[list[int]], dict[str, Any]]:
    """Return [x, y, t] of the events of a bag, and its metadata."""
    recording = open_recording(path)
    events = recording.events.slice(0, 10_000_000)
    return np.column_stack([events.x, events.y, events.t]).tolist(), recording.metadata


# Lost packets.


@pytest.mark.parametrize("ros1", [True, False])
def test_lost_packets_are_named_and_leave_no_stale_row_or_time(tmp_path: Path, ros1: bool) -> None:
    stale = [ON | 1, HIGH | 2, ON | 2, 0x4003, 0xA001, LOW | 9, ON | 3, 0x5001, 0xA001]
    placed = [ROW | 30, 0x4007, ON | 4, BASE | 40, 0x4001, 0x5001]
    messages = [
        message(one_event(4096 + 50), 10, ros1=ros1),
        message([*stale, *placed], 14, ros1=ros1),
        message(one_event(9000), 15, ros1=ros1),
        message(one_event(9001), 17, ros1=ros1),
    ]
    t = 2 * 4096 + 9
    found, about = rows(bag(tmp_path, messages, ros1=ros1))
    assert found == [[5, 7, 4146], [4, 30, t], [40, 30, t], [52, 30, t], [5, 7, 9000], [5, 7, 9001]]
    assert about["missing_packets"] == 4
    assert about["packet_gaps"] == 2
    assert about["largest_packet_gap"] == 3
    assert about["largest_packet_gap_us"] == 4146
    # 1, 2, two pixels and an edge without time; 3 and a pixel without row; three pixels without column
    assert about["dropped_unplaced_events"] == 1 + 1 + 2 + 1 + 1 + 1 + 3
    assert about["triggers"] == 1


def test_the_state_after_lost_packets_may_come_in_a_later_packet(tmp_path: Path) -> None:
    messages = [
        message(one_event(5000), 0),
        message([HIGH | 3, ON | 1], 2),
        message([ON | 2, LOW | 4, ON | 3], 3),
        message([ROW | 9, ON | 6], 4),
        message([ON | 8], 5),
    ]
    found, about = rows(bag(tmp_path, messages))
    assert found == [[5, 7, 5000], [6, 9, (3 << 12) + 4], [8, 9, (3 << 12) + 4]]
    assert about["dropped_unplaced_events"] == 3


@pytest.mark.parametrize("encoding", ["evt2", "evt21"])
def test_lost_packets_of_evt_2(tmp_path: Path, encoding: str) -> None:
    vectors = encoding == "evt21"
    shift = 32 if vectors else 0
    pixels = 0b101 if vectors else 0

    def words(*heads: int) -> list[int]:
        return [head << shift | pixels * (head >> 28 <= 1) for head in heads]

    high, event, edge = 0x8 << 28, 1 << 28 | 3 << 22 | 64 << 11 | 9, 0xA << 28 | 1
    messages = [
        message(words(high | 100, event), 1, encoding=encoding),
        message(words(event, edge, high | 103, event, edge), 3, encoding=encoding),
    ]
    found, about = rows(bag(tmp_path, messages))
    columns = [64, 66] if vectors else [64]
    assert found == [[x, 9, 64 * each + 3] for each in (100, 103) for x in columns]
    assert (about["missing_packets"], about["dropped_unplaced_events"]) == (1, len(columns) + 1)
    assert about["triggers"] == 1


def test_numbers_that_start_again_or_stand_still_are_no_lost_packets(tmp_path: Path) -> None:
    messages = [
        message(one_event(1000), 2**64 - 1),
        message(one_event(2000), 0),
        message(one_event(3000), 1),
    ]
    found, about = rows(bag(tmp_path, messages))
    assert [t for _, _, t in found] == [1000, 2000, 3000]
    assert not {"missing_packets", "packet_gaps", "largest_packet_gap"} & set(about)
    found, notes = placed([0, 1, 3, 3, 2**63, 2**63 + 1, 4])
    assert found == [0, 0, 1, 0, RESTART, 0, RESTART]
    assert notes == {"missing_packets": 1, "packet_gaps": 1}


def numbered_message(number: int, stamp: int = 0, raw: bytes = b"", publisher: int = 0) -> Numbered:
    """Return a message with a number. ``stamp`` [ns]."""
    return Numbered(Message(SimpleNamespace(id=publisher), 0, raw), None, number, stamp)


def placed(given: list[int], stamps: list[float] | None = None) -> tuple[list[int], dict[str, int]]:
    """Return what the numbers of messages tell, each on its own, and the counts. ``stamps`` [s]."""
    notes: dict[str, int] = {}
    numbers = MessageNumbers(notes)
    times = [0.0] * len(given) if stamps is None else stamps
    messages = [
        numbered_message(number, round(time * SECOND), bytes([at]))
        for at, (number, time) in enumerate(zip(given, times, strict=True))
    ]
    return [each.missing for message_ in messages for each in numbers.place(message_)], notes


def test_each_publisher_counts_for_itself() -> None:
    notes: dict[str, int] = {}
    numbers = MessageNumbers(notes)
    given = [
        numbered_message(number, raw=bytes([number]), publisher=of)
        for number, of in ((4, 0), (90, 1), (6, 0))
    ]
    assert [each.missing for message_ in given for each in numbers.place(message_)] == [0, 0, 1]
    assert notes == {"missing_packets": 1, "packet_gaps": 1}


# Late and repeated packets.


def counted(count: int, *, ros1: bool = False) -> list[Any]:
    """Return packets of one event each, 10 ms apart, numbered from 100 on, with right stamps."""
    return [
        message(one_event(10_000 * k + 5000), 100 + k, 50 + k / 100, ros1=ros1)
        for k in range(count)
    ]


ORDERS = {
    "swapped": ([0, 1, 2, 4, 3, 5, 6, 7], 1, 0),
    "all pairs swapped": ([1, 0, 3, 2, 5, 4, 7, 6], 4, 0),
    "late by three": ([0, 1, 2, 4, 5, 6, 3, 7], 1, 0),
    "two late": ([0, 1, 4, 5, 3, 2, 6, 7], 2, 0),
    "two late in their order": ([0, 1, 4, 5, 2, 3, 6, 7], 2, 0),
    "repeated at once": ([0, 0, 1, 2, 3, 4, 4, 5, 6, 7], 0, 2),
    "repeated later": ([0, 1, 2, 3, 4, 5, 2, 6, 7, 0], 0, 2),
    "late and repeated": ([0, 1, 3, 2, 2, 4, 5, 6, 7], 1, 1),
    "as they were sent": ([0, 1, 2, 3, 4, 5, 6, 7], 0, 0),
}


@pytest.mark.parametrize("ros1", [True, False])
@pytest.mark.parametrize("name", ORDERS)
def test_late_packets_are_put_in_their_place_and_repeated_ones_dropped(
    tmp_path: Path, name: str, ros1: bool
) -> None:
    order, late, repeated = ORDERS[name]
    given = counted(8, ros1=ros1)
    found, about = rows(bag(tmp_path, [given[k] for k in order], ros1=ros1))
    assert [row[2] for row in found] == [10_000 * k + 5000 for k in range(8)]
    assert (about.get("late_packets", 0), about.get("repeated_packets", 0)) == (late, repeated)
    assert not {"clock_restarts", "missing_packets", "packet_gaps", "repaired_time_events"} & set(
        about
    )


def test_words_of_late_packets_are_decoded_in_their_place(tmp_path: Path) -> None:
    """Their time, row and column are those of the packet before."""
    given = [
        message([HIGH, LOW | 9, ROW | 3, ON | 1, 0xA001], 7, 50.0),
        message([ON | 2, BASE | 40], 8, 50.001),
        message([0x4003, ROW | 4, LOW | 12, 0xA001], 9, 50.002),
        message([ON | 5], 10, 50.003),
    ]
    path = bag(tmp_path, [given[k] for k in (0, 3, 2, 1)])
    found, about = rows(path)
    assert found == [[1, 3, 9], [2, 3, 9], [40, 3, 9], [41, 3, 9], [5, 4, 12]]
    assert (about["late_packets"], "dropped_unplaced_events" in about) == (2, False)
    assert read_encoder_triggers(path, 0).t.tolist() == [9, 12]


@pytest.mark.parametrize("late", [AHEAD, AHEAD + 1])
def test_a_packet_that_is_too_late_keeps_its_place_and_time(tmp_path: Path, late: int) -> None:
    """The events behind it are not moved."""
    count = 3 * AHEAD
    given = [message(one_event(40 * k + 5000, y=k), 100 + k, 50 + k / 25_000) for k in range(count)]
    order = [0, *range(2, late + 2), 1, *range(late + 2, count)]
    found, about = rows(bag(tmp_path, [given[k] for k in order]))
    assert (about["late_packets"], "clock_restarts" in about) == (1, False)
    assert [row[2] for row in found[-5:]] == [40 * k + 5000 for k in range(count - 5, count)]
    if late == AHEAD:
        assert "missing_packets" not in about
        assert [row[1] for row in found[:3]] == [0, 1, 2]
        assert "repaired_time_events" not in about
    else:
        assert about["missing_packets"] == 1
        assert [row[1] for row in found[:3]] == [0, 2, 3]
        at = [row[1] for row in found].index(1)
        assert found[at - 1][2] == found[at][2]  # its time, repaired and counted
        assert about["repaired_time_events"] == 1


def test_words_behind_a_packet_that_is_too_late_do_not_follow_it(tmp_path: Path) -> None:
    count = AHEAD + 5
    given = [message(one_event(10 * k + 5000, y=k), k, 50 + k / 100_000) for k in range(count)]
    given[-1] = message([ON | 1, *one_event(6000)], count - 1, 51.0)
    order = [0, *range(2, count - 1), 1, count - 1]
    found, about = rows(bag(tmp_path, [given[k] for k in order]))
    assert found[-1] == [5, 7, 6000]
    assert [1, 1, 5010] not in found
    assert about["dropped_unplaced_events"] == 1


@pytest.mark.parametrize("encoding", ["mono", "array"])
def test_late_and_repeated_messages_of_other_encodings(tmp_path: Path, encoding: str) -> None:
    messages = (
        arrays(EVENTS, ros1=True) if encoding == "array" else packets("mono", EVENTS, ros1=True)
    )
    for number, each in enumerate(messages):
        if encoding == "array":
            each.header.seq = number
        else:
            each.seq = number
    path = bag(
        tmp_path, [messages[0], messages[2], messages[1], messages[2], *messages[3:]], ros1=True
    )
    recording = open_recording(path)
    assert_equal(recording.events.slice(0, 999), EVENTS)
    known = {"late_packets": 1, "repeated_packets": 1}
    assert {name: recording.metadata[name] for name in known} == known
    assert not {"missing_packets", "repaired_time_events"} & set(recording.metadata)


@pytest.mark.parametrize("ros1", [True, False])
def test_copies_of_bags_with_late_packets_are_in_order(tmp_path: Path, ros1: bool) -> None:
    given = counted(8, ros1=ros1)
    path = bag(tmp_path, [given[k] for k in (1, 0, 4, 3, 2, 5, 7, 6)], ros1=ros1)
    copy = tmp_path / ("copy.bag" if ros1 else "copy.mcap")
    convert(path, copy)
    assert [row[2] for row in rows(copy)[0]] == [10_000 * k + 5000 for k in range(8)]
    assert "late_packets" not in rows(copy)[1]


def test_a_driver_that_starts_again_soon_is_told_from_late_packets_by_the_stamps(
    tmp_path: Path,
) -> None:
    """Its numbers fall by a little only, but the stamps go on, and the clock of the sensor does not."""
    first = [message(one_event(2_000_000 + 1000 * k), k, 50 + k / 1000) for k in range(20)]
    second = [message(one_event(1000 * k), k, 53 + k / 1000) for k in range(20)]
    found, about = rows(bag(tmp_path, [*first, *second]))
    times = [row[2] for row in found]
    assert times[:20] == [2_000_000 + 1000 * k for k in range(20)]
    assert times[20] == pytest.approx(5_000_000, abs=4096)
    assert np.diff(times[20:]).tolist() == [1000] * 19
    assert about["clock_restarts"] == 1
    assert not {
        "late_packets",
        "repeated_packets",
        "missing_packets",
        "repaired_time_events",
    } & set(about)


@pytest.mark.parametrize(
    ("numbers", "stamps", "known"),
    [
        pytest.param([500, 501, 480, 502], [5.00, 5.01, 4.80, 5.02], LATE, id="earlier stamp"),
        pytest.param(
            [500, 501, 7, 502], [5.00, 5.01, 0.07, 5.02], LATE, id="earlier stamp, one of the first"
        ),
        pytest.param([500, 501, 480, 502], [0.0] * 4, LATE, id="no stamps"),
        pytest.param(
            [900, 901, 480, 902], [0.0] * 4, LATE, id="no stamps, a large fall to a large number"
        ),
        pytest.param(
            [500, 501, 7, 8], [0.0] * 4, RESTART, id="no stamps, a large fall to one of the first"
        ),
        pytest.param([500, 501, 7, 8], [5e3, 5001, 10, 11], RESTART, id="stamps set back"),
        pytest.param([500, 501, 480, 481], [5.00, 5.01, 5.51, 5.52], RESTART, id="stamps go on"),
        pytest.param(
            [500, 501, 480, 502], [5.00, 5.01, 5.50, 5.02], LATE, id="too early for a new start"
        ),
    ],
)
def test_falls_of_numbers(numbers: list[int], stamps: list[float], known: int) -> None:
    found, notes = placed(numbers, stamps)
    assert found == [0, 0, known, 0]
    assert notes == ({"late_packets": 1} if known == LATE else {})


def test_a_wrong_number_does_not_make_all_later_packets_late() -> None:
    count = FIRST_NUMBERS + 5
    found, notes = placed([2000, 2**30, *range(2001, 2001 + count)])
    assert found[2:] == [LATE] * FIRST_NUMBERS + [RESTART, 0, 0, 0, 0]
    assert notes["late_packets"] == FIRST_NUMBERS


def test_messages_without_a_number_have_that_of_their_header() -> None:
    assert number_of(SimpleNamespace(seq=np.uint64(5), header=SimpleNamespace(seq=9))) == 5
    assert number_of(SimpleNamespace(header=SimpleNamespace(seq=9))) == 9
    assert number_of(SimpleNamespace(header=SimpleNamespace())) == 0


def test_a_restarted_driver_has_no_stale_row_and_its_clock_goes_on_by_the_stamps(
    tmp_path: Path,
) -> None:
    messages = [
        message(one_event(8_000_000), 500, 100.0),
        message(one_event(8_001_000), 501, 100.001),
        message([HIGH, LOW | 100, ON | 1, ROW | 3, ON | 2], 0, 103.001),
        message(one_event(1100), 1, 103.002),
    ]
    found, about = rows(bag(tmp_path, messages))
    assert found[:2] == [[5, 7, 8_000_000], [5, 7, 8_001_000]]
    assert [row[:2] for row in found[2:]] == [[2, 3], [5, 7]]
    # The unit of the upper bits of the time
    assert found[2][2] == pytest.approx(11_001_000, abs=4096)
    assert found[3][2] - found[2][2] == 1000
    assert (about["clock_restarts"], about["dropped_unplaced_events"]) == (1, 1)
    assert "missing_packets" not in about
    assert "repaired_time_events" not in about


def test_a_restart_is_found_also_if_its_first_packets_have_no_word_of_the_time(
    tmp_path: Path,
) -> None:
    messages = [
        message(one_event(8_000_000), 500, 100.0),
        message([ROW | 3, ON | 1], 0, 103.0),
        message([LOW | 5, ON | 2], 1, 103.001),
        message(one_event(4100), 2, 103.002),
        message(one_event(4200), 3, 103.003),
        message(one_event(4300), 4, 115.004),  # the computer's clock was set
    ]
    found, about = rows(bag(tmp_path, messages))
    assert len(found) == 4
    assert found[1][2] == pytest.approx(11_002_000, abs=4096)
    assert [row[2] - found[1][2] for row in found[2:]] == [100, 200]
    assert (about["clock_restarts"], about["dropped_unplaced_events"]) == (1, 2)


def test_a_clock_that_goes_on_after_new_numbers_is_not_shifted(tmp_path: Path) -> None:
    messages = [message(one_event(8_000_000), 500, 100.0), message(one_event(8_001_000), 0, 100.3)]
    found, about = rows(bag(tmp_path, messages))
    assert [row[2] for row in found] == [8_000_000, 8_001_000]
    assert "clock_restarts" not in about


def test_a_restart_never_leads_back_in_time(tmp_path: Path) -> None:
    long = [word for t in range(8_000_000, 8_300_000, 5000) for word in one_event(t)]
    messages = [
        message(long, 500, 100.0),
        message(one_event(0), 0, 100.0),
        message(one_event(40), 1, 100.0),
    ]
    found, about = rows(bag(tmp_path, messages))
    assert [row[2] for row in found[-3:]] == [8_295_000, 8_295_000, 8_295_040]
    assert "repaired_time_events" not in about


@pytest.mark.parametrize("encoding", ["mono", "array"])
def test_lost_messages_of_other_encodings_are_named(tmp_path: Path, encoding: str) -> None:
    """Arrays of ROS 1 have the number of their header."""
    messages = (
        arrays(EVENTS, ros1=True) if encoding == "array" else packets("mono", EVENTS, ros1=True)
    )
    for number, each in enumerate(messages):
        later = number + 7 if number > 1 else number
        if encoding == "array":
            each.header.seq = later
        else:
            each.seq = later
    recording = open_recording(bag(tmp_path, messages, ros1=True))
    assert_equal(recording.events.slice(0, 999), EVENTS)
    before = 1 + 2 if encoding == "array" else 400
    known = (7, 1, 7, EVENTS.t[before - 1])
    names = ("missing_packets", "packet_gaps", "largest_packet_gap", "largest_packet_gap_us")
    assert tuple(recording.metadata[name] for name in names) == known


def test_info_names_lost_packets(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from tests.command_line import app

    path = bag(tmp_path, [message(one_event(1000), 0), message(one_event(2000), 9)])
    result = CliRunner().invoke(app, ["info", str(path)])
    text = " ".join(result.output.split())
    assert (
        "missing_packets 8, packet_gaps 1, largest_packet_gap 8, largest_packet_gap_us 1,000"
        in text
    )


# Pauses.


@pytest.mark.parametrize("pause", [9.0, 16.0, 17.0, 40.0, 3600.0])
def test_a_pause_longer_than_the_clock_of_the_sensor_is_known_from_the_stamps(
    tmp_path: Path, pause: float
) -> None:
    us = round(pause * 1e6)
    messages = [
        message(one_event(5_000_000), 0, 50.0),
        message(one_event(5_000_500), 1, 50.0005),
        # the second packet waits for 0.6 s in the computer
        message(one_event(5_000_500 + us), 2, 50.0005 + pause + 0.6),
        message(one_event(5_000_900 + us), 3, 50.0009 + pause),
    ]
    found, about = rows(bag(tmp_path, messages))
    assert [row[2] for row in found] == [5_000_000, 5_000_500, 5_000_500 + us, 5_000_900 + us]
    assert about["long_pauses"] == 1


def test_a_pause_is_found_also_if_its_first_packets_have_no_word_of_the_time(
    tmp_path: Path,
) -> None:
    pause = 40_000_000
    messages = [
        message(one_event(5000), 0, 50.0),
        message([ON | 1], 1, 50.001),
        message([ON | 2, LOW | 9], 3, 90.001),
        message([LOW | 9, ROW | 4, *one_event(5004 + pause)], 4, 90.002),
    ]
    found, about = rows(bag(tmp_path, messages))
    assert found == [[5, 7, 5000], [1, 7, 5000], [5, 7, 5004 + pause]]
    assert (about["long_pauses"], about["missing_packets"], about["dropped_unplaced_events"]) == (
        1,
        1,
        1,
    )


@pytest.mark.parametrize("encoding", ["evt2", "evt21"])
def test_a_pause_of_evt_2(tmp_path: Path, encoding: str) -> None:
    """Its clock wraps after 4.8 h."""
    times = [3_000_000, 3_000_000 + 10 * 3600 * 10**6]
    vectors = encoding == "evt21"
    messages = []
    for t in times:
        events = Events.from_arrays([3], [4], [t], [1])
        messages.append(
            message(
                evt2_words(events, vectors=vectors), len(messages), t / 1e6 + 7, encoding=encoding
            )
        )
    found, about = rows(bag(tmp_path, messages))
    assert [row[2] for row in found] == times
    assert about["long_pauses"] == 1


STAMPS = {
    "late": [0.0, 0.001, 1.002, 0.003, 0.004],
    "one far too late, by a whole turn": [0.0, 0.001, 0.002 + PERIOD / 1e6, 0.003, 0.004],
    "set forward": [0.0, 0.001, 110.002, 110.003, 110.004],
    "set forward from 1970, by whole turns": [
        0.0,
        0.001,
        *(k / 1000 + 100_000_000 * PERIOD / 1e6 for k in (2, 3, 4)),
    ],
    "set forward a little": [0.0, 0.001, 12.002, 12.003, 12.004],
    "set back": [1000.0, 1000.001, 0.002, 0.003, 0.004],
    "set back by a turn": [
        100.0,
        100.001,
        100.002 - PERIOD / 1e6,
        100.003 - PERIOD / 1e6,
        100.004 - PERIOD / 1e6,
    ],
    "missing": [0.0, 0.0, 0.0, 0.0, 0.0],
}


@pytest.mark.parametrize("name", STAMPS)
def test_wrong_stamps_make_no_pause(tmp_path: Path, name: str) -> None:
    times = [5_000_000 + 1000 * k for k in range(5)]
    messages = [
        message(one_event(t), k, stamp)
        for k, (t, stamp) in enumerate(zip(times, STAMPS[name], strict=True))
    ]
    found, about = rows(bag(tmp_path, messages))
    assert [row[2] for row in found] == times
    assert "long_pauses" not in about


def test_pauses_whose_words_tell_all_turns_are_left_as_they_are(tmp_path: Path) -> None:
    """amiwarp's own bags write words of the time also in pauses."""
    t = (
        EVENTS.t
        + (np.arange(len(EVENTS)) > 300) * 40_000_000
        + (np.arange(len(EVENTS)) > 400) * 12_000_000
    )
    events = Events(EVENTS.x, EVENTS.y, t, EVENTS.p)
    np.savez(
        tmp_path / "a.npz", x=events.x, y=events.y, t=t, p=events.p, width=SIZE[0], height=SIZE[1]
    )
    convert(tmp_path / "a.npz", tmp_path / "a.mcap")
    recording = open_recording(tmp_path / "a.mcap")
    assert_equal(recording.events.slice(0, 999), events)
    assert not {"long_pauses", "missing_packets", "dropped_unplaced_events"} & set(
        recording.metadata
    )


def test_triggers_and_copies_follow_the_clock_of_the_events(tmp_path: Path) -> None:
    pause = 40_000_000
    edges = [[0xA001], [0xA001]]
    messages = [
        message([*one_event(1000), *edges[0]], 0, 50.0),
        message([HIGH | 1, LOW], 1, 50.1),
        message([*one_event(1000 + pause), ON | 6, *edges[1]], 2, 90.0),
        message(one_event(2000 + pause), 3, 90.001),
    ]
    path = bag(tmp_path, messages)
    assert np.diff(read_encoder_triggers(path, 0).t).tolist() == [pause]
    convert(path, tmp_path / "copy.mcap")
    known = [[5, 7, 1000], [5, 7, 1000 + pause], [6, 7, 1000 + pause], [5, 7, 2000 + pause]]
    assert rows(tmp_path / "copy.mcap")[0] == known
    store = typestore(False)
    with ros_bags.opened_bag(str(tmp_path / "copy.mcap")) as (copy, _):
        read = [
            store.deserialize_cdr(raw, one.msgtype)
            for one, _, raw in copy.messages(connections=copy.connections)
        ]
    stamps = [each.header.stamp.sec + each.header.stamp.nanosec / 1e9 for each in read]
    assert stamps == pytest.approx([50.0, 90.0, 90.001], abs=1e-9)


@pytest.mark.parametrize("encoding", ["evt3", "mono"])
def test_messages_that_only_the_index_lists_are_counted(tmp_path: Path, encoding: str) -> None:
    """The first message has become a record of another type, which readers of MCAP pass over."""
    messages = packets(encoding, EVENTS)
    path = write_ros2(tmp_path / "a", {"/events": messages}, storage="MCAP")
    data = bytearray(path.read_bytes())
    first = data.index(bytes(messages[0].events)[:40])
    at = data.rindex(b"\x05", 0, first - 30)
    while int.from_bytes(data[at + 1 : at + 9], "little") != 22 + len(
        typestore(False).serialize_cdr(messages[0], "event_camera_msgs/msg/EventPacket")
    ):
        at = data.rindex(b"\x05", 0, at)
    data[at] = 0x7F
    path.write_bytes(data)
    recording = open_recording(path)
    assert len(recording.events) == len(EVENTS) - 200
    assert recording.metadata["unread_messages"] == 1


@pytest.mark.parametrize("ros1", [True, False])
@pytest.mark.parametrize("stated", [0, 99, 101])
def test_an_array_with_another_number_of_events_than_it_states_is_refused(
    ros1: bool, stated: int
) -> None:
    """Events behind the stated number would be lost unsaid."""
    store = typestore(ros1)
    made = array_message(store, EVENTS[:100], ros1=ros1)
    raw = bytearray((store.serialize_ros1 if ros1 else store.serialize_cdr)(made, made.__msgtype__))
    at = raw.index(struct.pack("<III", SIZE[1], SIZE[0], 100)) + 8
    assert len(decode_array(bytes(raw), ros1=ros1)[2][2]) == 100
    assert ros1 or len(decode_array(bytes(raw) + bytes(3), ros1=ros1)[2][2]) == 100
    raw[at : at + 4] = struct.pack("<I", stated)
    with pytest.raises(
        AmiwarpError, match=f"declares {stated} events, but has .* bytes; expected "
    ):
        decode_array(bytes(raw), ros1=ros1)


@pytest.mark.parametrize("ros1", [True, False])
def test_an_array_that_ends_in_its_header_is_refused(ros1: bool) -> None:
    store = typestore(ros1)
    made = array_message(store, EVENTS[:5], ros1=ros1)
    raw = bytes((store.serialize_ros1 if ros1 else store.serialize_cdr)(made, made.__msgtype__))
    for length in (7, 15, 22):
        with pytest.raises(AmiwarpError, match=r"bytes, whose header alone needs .*copy") as caught:
            decode_array(raw[:length], ros1=ros1)
        assert caught.value.code is ErrorCode.FILE_DAMAGED
    with pytest.raises(AmiwarpError, match=r"encapsulation 0000; .* ros2 bag convert") as caught:
        decode_array(b"\0\0" + raw[2:], ros1=False)
    assert caught.value.code is ErrorCode.FORMAT_UNKNOWN


@pytest.mark.parametrize("encoding", ["evt3", "evt2"])
def test_words_of_unknown_types_in_bags_are_counted(tmp_path: Path, encoding: str) -> None:
    words = (
        packets(encoding, EVENTS[:100])[0]
        .events.view({"evt3": "<u2", "evt2": "<u4"}[encoding])
        .copy()
    )
    shift = 8 * words.itemsize - 4
    more = [*words.tolist(), 0x9 << shift, 0xB << shift | 5, 0xE << shift]
    recording = open_recording(bag(tmp_path, [message(more, 0, encoding=encoding)]))
    assert len(recording.events) == 100
    assert recording.metadata["unknown_words"] == 2


# The order of the halves of EVT 2.1.


@pytest.mark.parametrize("swapped", [True, False])
def test_both_orders_of_evt21_in_bags(tmp_path: Path, swapped: bool) -> None:
    words = evt2_words(EVENTS, vectors=True)
    if swapped:
        words = words >> np.uint64(32) | words << np.uint64(32)
    messages = [
        message(part, k, encoding="evt21") for k, part in enumerate(np.array_split(words, 3))
    ]
    recording = open_recording(bag(tmp_path, messages))
    assert_equal(recording.events.slice(0, 999), EVENTS)
    assert "word_order" not in recording.metadata


def test_an_uncertain_order_of_evt21_is_said_and_none_is_refused(tmp_path: Path) -> None:
    high = 0x80000005
    event = 1 << 28 | 64 << 11 | 9
    both = [
        high << 32 | 0x80000001,
        (high + 1) << 32 | 0x80000002,
        (high + 2) << 32,
        event << 32 | 1,
    ]
    recording = open_recording(bag(tmp_path, [message(both, encoding="evt21")]))
    assert len(recording.events) == 1
    assert "assumed to be not swapped" in recording.metadata["word_order"]
    falling = [(high - k) << 32 | 1 for k in range(4)] + [event << 32 | 1]
    path = bag(tmp_path, [message(falling, encoding="evt21")], name="b")
    assert "without times that rise, in either order of their 32-bit halves" in str(
        refusal(open_recording, path)
    )
    unknown = [0x30000000_30000000 + k for k in range(50)] + [high << 32]
    path = bag(tmp_path, [message(unknown, encoding="evt21")], name="c")
    assert "either order" in str(refusal(open_recording, path))


def test_the_order_of_halves_is_found_from_vectors_of_one_pixel() -> None:
    """The last of 32 pixels has the bits of a word of the time, which stands still."""
    words = evt2_words(Events(EVENTS.x // 32 * 32 + 31, EVENTS.y, EVENTS.t, EVENTS.p), vectors=True)
    swapped = words >> np.uint64(32) | words << np.uint64(32)
    assert halves_of(words) == Halves(False, certain=True)
    assert halves_of(swapped) == Halves(True, certain=True)
    assert halves_of(words[:0]) is None


def test_big_endian_words_of_evt21_are_named(tmp_path: Path) -> None:
    big = message(evt2_words(EVENTS, vectors=True).astype(">u8").view("<u8"), encoding="evt21")
    big.is_bigendian = True
    assert "big-endian words" in str(refusal(open_recording, bag(tmp_path, [big])))


def test_encodings_do_not_change_within_a_topic(tmp_path: Path) -> None:
    messages = [message(one_event(1000), 0), message([0x80000001, 1 << 28], 1, encoding="evt2")]
    text = str(refusal(open_recording, bag(tmp_path, messages)))
    assert "has packets of the encodings 'evt3' and 'evt2' in one topic" in text
    messages = [*packets("mono", EVENTS), message(one_event(1000), 1)]
    text = str(refusal(open_recording, bag(tmp_path, messages, name="b")))
    assert "has packets of several encodings, now 'evt3'; record the topic again" in text


# Messages of iniVation's packages.


@pytest.mark.parametrize(("package", "ros1"), [("dv_ros_msgs", True), ("dv_ros2_msgs", False)])
def test_arrays_of_inivation(tmp_path: Path, package: str, ros1: bool) -> None:
    path = bag(tmp_path, arrays(EVENTS, ros1=ros1, package=package), ros1=ros1)
    recording = open_recording(path)
    assert recording.events.size == SIZE
    assert_equal(recording.events.slice(0, 999), EVENTS)


# Damaged and empty bags.


@pytest.mark.parametrize("encoding", ["evt3", "mono"])
def test_bytes_that_are_no_whole_word_are_counted(tmp_path: Path, encoding: str) -> None:
    messages = packets(encoding, EVENTS)
    for number, each in enumerate(messages):
        each.seq = number
    cut = messages[1].events[:-1]
    messages[1].events = cut
    recording = open_recording(bag(tmp_path, messages))
    rest = len(cut) % (2 if encoding == "evt3" else 8)
    assert recording.metadata["truncated_bytes"] == rest > 0


def test_words_behind_a_packet_that_is_cut_off_do_not_follow_it(tmp_path: Path) -> None:
    """The lost word may be that of the row."""
    broken = message([*one_event(6000), ROW | 9], 1)
    broken.events = broken.events[:-1]
    given = [
        message(one_event(5000), 0),
        broken,
        message([ON | 1, *one_event(7000), ON | 2], 2),
        message([ON | 3], 3),
    ]
    found, about = rows(bag(tmp_path, given))
    assert found == [[5, 7, 5000], [5, 7, 6000], [5, 7, 7000], [2, 7, 7000], [3, 7, 7000]]
    assert (about["truncated_bytes"], about["dropped_unplaced_events"]) == (1, 1)


def test_ros1_bags_that_are_cut_off_or_not_ended_are_named(tmp_path: Path) -> None:
    whole = bag(tmp_path, packets("evt3", EVENTS, ros1=True), ros1=True).read_bytes()
    (place,) = re.findall(rb"index_pos=(.{8})", whole[:4096], re.DOTALL)
    index = int.from_bytes(place, "little")
    path = tmp_path / "cut.bag"
    reindex = "copy the whole file again, or run rosbag reindex"
    known = {
        index: f"is cut off: it ends after {index:,} bytes, and its index is at byte {index:,}; {reindex}",
        5000: f"is cut off: it ends after 5,000 bytes, and its index is at byte {index:,}; {reindex}",
        index + 20: f"is cut off within its index, or the index is damaged; {reindex}",
        len(whole) - 3: f"is cut off within its index, or the index is damaged; {reindex}",
        30: "is cut off within its header; copy the whole file again",
    }
    for length, text in known.items():
        path.write_bytes(whole[:length])
        assert str(refusal(open_recording, path)).endswith(f": {text}")
    path.write_bytes(whole.replace(b"index_pos=" + place, b"index_pos=" + bytes(8)))
    text = str(refusal(open_recording, path))
    assert text.endswith("has no index, because its recording was not ended; run rosbag reindex")


@pytest.mark.parametrize("end", [".db3", ".mcap", ".db3.zstd"])
def test_the_folder_of_a_bag_without_its_metadata_is_named(tmp_path: Path, end: str) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "notes.txt").write_text("x")
    assert "is a folder; give a regular file" in str(refusal(open_recording, folder))
    (folder / f"bag_0{end}").write_bytes(b"x")
    text = str(refusal(open_recording, folder))
    assert "is the folder of a ROS 2 bag without its metadata.yaml; run ros2 bag reindex" in text


@pytest.mark.parametrize("end", [".bag", ".mcap", ".db3"])
def test_empty_bags_hold_no_events(tmp_path: Path, end: str) -> None:
    save_recording(tmp_path / "a.h5", Recording(MemoryEvents(Events.empty(), *SIZE)))
    path = tmp_path / f"a{end}"
    convert(tmp_path / "a.h5", path)
    topic = "/dvs/events" if end == ".bag" else "/event_camera/events"
    text = str(refusal(open_recording, path))
    assert f"holds no events: its topic {topic} has no messages; give another recording" in text
    text = str(refusal(lambda: open_recording(path, topic="/other")))
    assert "without event topics; its topics are" in text


# Times since 1970.


@pytest.mark.parametrize("end", [".mcap", ".db3", ".bag", ".raw"])
@pytest.mark.parametrize("command", ["convert", "filter"])
def test_times_that_only_the_stamps_of_a_ros2_bag_hold_are_named(
    tmp_path: Path, end: str, command: str
) -> None:
    from typer.testing import CliRunner

    from tests.command_line import app

    longest = 100_000_000_000
    for first, moved in (
        (1_700_000_000_000_000, True),
        (longest - 20, False),
        (longest - 19, True),
    ):
        events = Events.from_arrays([1, 2], [3, 4], [first, first + 20], [1, 0])
        save_recording(tmp_path / "a.h5", Recording(MemoryEvents(events, *SIZE)), overwrite=True)
        path = tmp_path / f"{first}{end}"
        options = ["--region", "0,0,99,99"] if command == "filter" else []
        result = CliRunner().invoke(app, [command, str(tmp_path / "a.h5"), str(path), *options])
        assert result.exit_code == 0, result.output
        text = " ".join(result.output.split())
        moves = moved and end in (".mcap", ".db3")
        note = f"note: the times begin at 0: {first:,} us are subtracted"
        assert (note in text, "subtracted" in text) == (moves, moves)
        assert open_recording(path).events.t_first == (0 if moves else first)


# Compressed bags.


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def compressed(tmp_path: Path, kind: str, storage: str) -> Path:
    """Write the events into a bag that is compressed by files or messages, as rosbag2 does, and return its folder."""
    folder = tmp_path / "packed"
    store = typestore(False)
    modes = {"message": CompressionMode.MESSAGE, "file": CompressionMode.FILE}
    writer = Writer2(folder, version=9, storage_plugin=StoragePlugin[storage])
    writer.set_compression(modes[kind], CompressionFormat.ZSTD)
    with writer:
        name = "event_camera_msgs/msg/EventPacket"
        connection = writer.add_connection("/events", name, typestore=store)
        for at, each in enumerate(packets("evt3", EVENTS)):
            each.seq = at
            writer.write(connection, at, store.serialize_cdr(each, name))
    return folder


def in_this_process(function: Any, *given: Any) -> Any:
    """Run a function of the reading process here, where its limits can be changed."""
    return function(*map(str, given))[0]


def zstd(path: Path, data: bytes) -> Path:
    """Write compressed data."""
    path.write_bytes(zstandard.compress(data))
    return path


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("kind", ["file", "message"])
def test_compressed_bags_of_ros_2(tmp_path: Path, scratch: Path, kind: str, storage: str) -> None:
    folder = compressed(tmp_path, kind, storage)
    file = next(each for each in folder.iterdir() if each.name != "metadata.yaml")
    assert (file.suffix == ".zstd") == (kind == "file")
    for path in (folder, file):
        recording = open_recording(path)
        assert_equal(recording.events.slice(0, 999), EVENTS)
        assert recording.name == "packed"
        assert recording.metadata["format"] == "rosbag2"
        assert bool(os.listdir(scratch)) == (kind == "file")
        convert(path, tmp_path / f"{file.stem}.{path.is_dir()}.h5")
        convert(path, tmp_path / f"{file.stem}.{path.is_dir()}.mcap")
        assert_equal(
            open_recording(tmp_path / f"{file.stem}.{path.is_dir()}.mcap").events.slice(0, 999),
            EVENTS,
        )
        del recording
        gc.collect()
        assert os.listdir(scratch) == []


@pytest.mark.parametrize("name", ["a.db3.zstd", "a.mcap.zstd", "a.bag.zstd"])
def test_a_lone_compressed_bag(
    tmp_path: Path, scratch: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amiwarp.io.file_scan.KEEP_EVENTS", 10)  # so that the copy is read again
    if ".bag" in name:
        write_ros1(tmp_path / "plain", {"/events": packets("evt3", EVENTS, ros1=True)})
        plain = tmp_path / "plain"
    else:
        storage = "MCAP" if ".mcap" in name else "SQLITE3"
        plain = write_ros2(
            tmp_path / "plain", {"/events": packets("evt3", EVENTS)}, storage=storage
        )
    path = zstd(tmp_path / name, plain.read_bytes())
    recording = open_recording(path)
    assert (recording.name, recording.events.path) == ("a", path)  # type: ignore[attr-defined]
    assert_equal(recording.events.slice(0, 999), EVENTS)
    events = recording.events
    del recording
    gc.collect()
    assert_equal(events.slice(0, 999), EVENTS)  # which are still used
    del events
    gc.collect()
    assert os.listdir(scratch) == []


def test_an_archive_of_several_frames_and_images_that_outlive_the_events(
    tmp_path: Path, scratch: Path
) -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    images = [
        image_message(typestore(True), True, 1_000_000 + k, "mono8", pixels + k) for k in range(2)
    ]
    write_ros1(
        tmp_path / "plain", {"/dvs/events": arrays(EVENTS, ros1=True), "/dvs/image_raw": images}
    )
    plain = (tmp_path / "plain").read_bytes()
    half = len(plain) // 2
    path = tmp_path / "a.bag.zst"
    path.write_bytes(zstandard.compress(plain[:half]) + zstandard.compress(plain[half:]))
    recording = open_recording(path)
    assert_equal(recording.events.slice(0, 999), EVENTS)
    frames = recording.frames
    assert frames is not None
    assert recording.name == "a"
    del recording
    gc.collect()
    np.testing.assert_array_equal(frames[1], pixels + 1)
    frames.close()  # type: ignore[attr-defined]
    del frames
    gc.collect()
    assert os.listdir(scratch) == []


def test_damaged_compressed_bags_are_named_and_leave_no_copy(
    tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = write_ros2(
        tmp_path / "plain", {"/events": packets("evt3", make_events(60_000))}
    ).read_bytes()
    whole = zstd(tmp_path / "a.db3.zstd", plain).read_bytes()
    cut = tmp_path / "cut.db3.zstd"
    cut.write_bytes(whole[:-200])
    assert re.search(
        r"cut\.db3\.zstd.* ends after [\d,]+ of [\d,]+ bytes", str(refusal(open_recording, cut))
    )
    for length in (len(whole) // 100, 40):
        cut.write_bytes(whole[:length])
        text = str(refusal(open_recording, cut))
        assert text == f"{cut}: is a Zstandard archive that is cut off; copy the whole file again"
    bad = tmp_path / "bad.db3.zstd"
    bad.write_bytes(whole[: len(whole) // 2] + bytes(50) + whole[len(whole) // 2 + 50 :])
    message_ = str(refusal(open_recording, bad))
    assert message_.startswith(str(bad))
    assert "damaged" in message_ or "malformed" in message_
    bomb = zstd(tmp_path / "bomb.db3.zstd", plain + bytes(1 << 26))
    with monkeypatch.context() as patch:
        patch.setattr(ros_packed, "SMALLEST_LIMIT", len(plain))
        patch.setattr(ros_packed, "LARGEST_RATIO", 10)
        patch.setattr(ros_packed, "run", in_this_process)
        most = max(len(plain), 10 * bomb.stat().st_size)
        text = str(refusal(open_recording, bomb))
    assert f"bomb.db3.zstd unpacks to over {most:,} bytes, too many for its size" in text
    other = zstd(tmp_path / "other.zstd", b"no bag")
    assert "is a Zstandard archive; unpack it first" in str(refusal(open_recording, other))
    assert os.listdir(scratch) == []


def test_a_full_disk_and_an_interrupt_leave_no_copy(
    tmp_path: Path, scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = write_ros2(tmp_path / "plain", {"/events": packets("evt3", EVENTS)}).read_bytes()
    path = zstd(tmp_path / "a.db3.zstd", plain)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(ros_packed, "_unpack_file", full)
        patch.setattr(ros_packed, "run", in_this_process)
        text = str(refusal(open_recording, path))
        assert f"is compressed, and {scratch}" in text
        assert "set TMPDIR to a folder with more space" in text
    assert os.listdir(scratch) == []

    def interrupted(*_: object) -> None:
        assert os.listdir(scratch)
        raise KeyboardInterrupt

    for where in ("amiwarp.io.ros.packed.run", "amiwarp.io.ros.reader.run"):
        with monkeypatch.context() as patch:
            patch.setattr(where, interrupted)
            with pytest.raises(KeyboardInterrupt):
                open_recording(path)
        assert os.listdir(scratch) == []


def test_a_compressed_message_that_grows_too_much_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ros_packed, "LARGEST_MESSAGE", 1 << 20)
    assert ros_packed.unpacked_message(zstandard.compress(bytes(1 << 20))) == bytes(1 << 20)
    with pytest.raises(AmiwarpError, match=r"a message unpacks to over 1048576 bytes"):
        ros_packed.unpacked_message(zstandard.compress(bytes((1 << 20) + 1)))
    with pytest.raises(AmiwarpError, match=r"a compressed message cannot be unpacked"):
        ros_packed.unpacked_message(b"\x28\xb5\x2f\xfd" + bytes(range(40)))


# Words of any kind, against a model that reads one word after the other.


def words_without_unknown(words: list[int], state: set[str]) -> list[int]:
    """Return EVT 3.0 words without the events whose time or place is not in the state, which the words extend."""
    kept = []
    for word in words:
        kind = word >> 12
        if kind in (0x2, 0x4, 0x5):
            needed = {"high", "low", "row"} | ({"base"} if kind != 0x2 else set())
            if not needed <= state:
                word = 0xF000 if kind == 0x2 else word & 0xF000
        if kind == 0xA and not {"high", "low"} <= state:
            word = 0xF000
        if kind == 0x6 and "high" in state:
            state.add("low")
        state |= {
            name for name, each in (("high", 0x8), ("row", 0x0), ("base", 0x3)) if kind == each
        }
        kept.append(word)
    return kept


def test_what_is_unknown_after_lost_packets_follows_the_words() -> None:
    rng = np.random.default_rng(5)
    layout = Layout("evt3")
    for _ in range(200):
        unknown = Unknown(layout)
        unknown.start()
        state: set[str] = set()
        for length in rng.integers(0, 12, 4):
            words = rng.integers(0, 1 << 16, length).astype("<u2")
            kept, count = unknown.without_events(words)
            known = words_without_unknown(words.tolist(), state)
            assert kept.tolist() == known
            lost = layout.counts(words).sum(dtype=int) - layout.counts(kept).sum(dtype=int)
            edges = np.count_nonzero((words >> 12 == 0xA) & (kept >> 12 != 0xA))
            assert count == lost + edges
        assert len(unknown.kinds) == 4 - len(state)


@pytest.mark.parametrize("encoding", ["evt3", "evt2", "evt21"])
@pytest.mark.parametrize("swapped", [True, False])
def test_events_of_each_word_are_counted(encoding: str, swapped: bool) -> None:
    layout = Layout(encoding, swapped and encoding == "evt21")
    words = random_words(layout.version, 3000, np.random.default_rng(2))
    decoder: Any = Evt3Decoder() if encoding == "evt3" else Evt2Decoder(vectors=encoding == "evt21")
    timed = words_of(
        np.array([0x8001 if encoding == "evt3" else 0x80000001], words.dtype).tobytes(),
        layout.version,
    )
    decoder.decode(timed << np.uint64(32) if encoding == "evt21" else timed)
    expected = [len(decoder.decode(words[k : k + 1])[0][2]) for k in range(len(words))]
    assert max(expected) > 1 or encoding == "evt2"
    given = swap_halves(words) if layout.swapped else words
    assert layout.counts(given).tolist() == expected
