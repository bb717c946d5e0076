"""Clocks of camera and controller under late reports, a busy computer, pulled cables and restarts: is one ever wrong?

    python -m benchmarks.clocks [--runs 200] [--seed 0] [--out FILE.json]

Each run plays an emulated controller and a camera, in simulated time, through the code of ``amiwarp live``: reports are
up to 5 s late, in bursts while the computer is busy, pulses are lost, cables pulled and plugged in again, controller
and camera restart, the controller's clock wraps, and quartzes differ by up to 100 ppm. All of it is drawn by seed. A
run is wrong if an angle that counts as measured belongs to a time that is more than 0.1 ms away. Simulated time does
not depend on the machine.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from amiwarp import EncoderStream, Events
from amiwarp.live.link.camera_clock import ClockSource
from amiwarp.live.link.clocks import WRAP
from amiwarp.live.link.emulated_faults import EmulatedFault
from amiwarp.live.link.emulator import Controller
from amiwarp.live.link.follower import Follower
from amiwarp.live.link.protocol import Ping, encode
from amiwarp.live.link.rotors import Motor
from amiwarp.live.link.updates import LinkUpdate
from amiwarp.live.stream.encoder_feed import EncoderFeed
from amiwarp.live.stream.packets import Packet, make_packet

STEP_US = 10_000
"""Step of the simulated time, and length of the camera's packets [us]."""
RPM = 720.0
WRONG_US = 100.0
"""Error of a measured angle's time from which on a run is wrong [us]: 0.4 degrees at 720 rpm."""
HELD_US = 12_000_000
"""Time that events may wait [us]: as long as reports may be late, and more."""
HOST_US = 9_000_000_000
"""Host's time at the start [us]."""


@dataclass(frozen=True)
class Troubles:
    """What happens in a run, drawn by seed."""

    seconds: float
    serial_delay_us: int
    """Delay of all that comes from the controller [us]."""
    camera_delay_us: int
    """Delay of all that comes from the camera [us]."""
    stalls: tuple[tuple[int, int], ...]
    """Times in which the computer reads nothing: from, to [us]."""
    lost: float
    """Share of the pulses that the camera misses."""
    trigger_cable: tuple[int, int]
    """Time in which the trigger's cable is pulled: from, to [us]; empty if both are equal."""
    camera_returns_us: int
    """Time at which the camera restarts with another clock [us]; negative for never."""
    faults: tuple[str, ...]
    """Faults of the controller and of its cable."""
    drift_ppm: float
    regular: bool
    """Whether the controller sends its pulses at regular intervals, as older firmware."""


def draw(seed: int) -> Troubles:
    """Return the troubles of a run."""
    rng = np.random.default_rng(seed)
    seconds = 30.0
    whole_us = round(seconds * 1e6)
    delays = [
        round(float(rng.choice([0.0, rng.uniform(0, 0.1e6), rng.uniform(0, 5e6)])))
        for _ in range(2)
    ]
    stalls = []
    for _ in range(int(rng.choice([0, 0, 5, 20]))):  # the loads of the computer
        begin = int(rng.integers(0, whole_us))
        stalls.append((begin, begin + int(rng.exponential(400_000))))
    pulled = int(rng.integers(3_000_000, 15_000_000))
    cable = (pulled, pulled + int(rng.choice([0, 0, 2_000_000, 8_000_000])))
    returns_us = int(rng.choice([-1, -1, -1, rng.integers(5_000_000, 20_000_000)]))
    faults = []
    for name, share in (
        ("unplug", 0.25),
        ("reset", 0.25),
        ("clock-jump", 0.15),
        ("crc", 0.15),
        ("drop", 0.15),
    ):
        if rng.uniform() < share:
            length = "+2" if name in ("unplug", "crc", "drop") else ""
            faults.append(f"{name}@{rng.uniform(3.0, 20.0):.3f}{length}")
    return Troubles(
        seconds=seconds,
        serial_delay_us=delays[0],
        camera_delay_us=delays[1],
        stalls=tuple(sorted(stalls)),
        lost=float(rng.choice([0.0, 0.05, 0.3])),
        trigger_cable=cable,
        camera_returns_us=returns_us,
        faults=tuple(faults),
        drift_ppm=float(rng.uniform(-100.0, 100.0)),
        regular=bool(rng.uniform() < 0.1),
    )


@dataclass(frozen=True)
class Outcome:
    """What came of a run."""

    seed: int
    wrong: int
    """Number of measured angles of a wrong time."""
    worst_us: float
    """Largest error of the time of a measured angle [us]."""
    measured: float
    """Share of the times with a measured angle."""
    paired_s: float | None
    """Time until the pulses were paired first [s]; None if they never were."""
    error_us: float | None
    """Median distance of the map from the truth at its pulses, while pulses were paired [us]. None if never, and in
    runs whose controller's clock jumps, because the emulator does not tell the time before the jump."""
    messages: tuple[str, ...]


class Delayed:
    """Items that arrive late and in order, and not while the computer reads nothing."""

    def __init__(self, delay_us: int, stalls: Sequence[tuple[int, int]]) -> None:
        self._delay_us, self._stalls = delay_us, stalls
        self._items: deque[tuple[int, Any]] = deque()

    def put(self, now_us: int, item: Any) -> None:
        """Send an item."""
        self._items.append((now_us + self._delay_us, item))

    def arrived(self, now_us: int) -> list[Any]:
        """Return the items that have arrived since the last call."""
        if any(begin <= now_us < end for begin, end in self._stalls):
            return []
        found = []
        while self._items and self._items[0][0] <= now_us:
            found.append(self._items.popleft()[1])
        return found


class SimulatedLink:
    """Link to an emulated controller, in simulated time. It has the methods of ``Link`` that a feed calls."""

    def __init__(self, controller: Controller, delayed: Delayed) -> None:
        self.follower = Follower("simulated")
        self.follower.opened(HOST_US)
        self._controller, self._delayed = controller, delayed
        self._pings = 0
        self._plugged = True

    def advance(self, now_us: int) -> None:
        """Run the controller to a time, and read what has arrived of it by then."""
        data = self._controller.advance(now_us)
        if self._controller.plugged:
            self._delayed.put(now_us, data)
        if self._controller.plugged and not self._plugged:
            self.follower.opened(HOST_US + now_us)
        self._plugged = self._controller.plugged
        for part in self._delayed.arrived(now_us):
            self.follower.feed(part, HOST_US + now_us)
        if now_us % 250_000 == 0:
            self.follower.pinged(self._pings, HOST_US + now_us)
            self._controller.feed(encode(Ping(self._pings), self._pings & 0xFFFF), now_us)
            self._pings += 1

    def poll(self) -> LinkUpdate:
        """Return the oldest update that was not returned yet."""
        return self.follower.take()

    def clock(self) -> Any:
        """Return the map from the host's clock to the controller's."""
        return self.follower.clock()


class SimulatedCamera:
    """Camera with a clock of its own, two events per packet, and a trigger input for the controller's pulses."""

    def __init__(self, about: Troubles, rng: np.random.Generator) -> None:
        self._about, self._rng = about, rng
        self._drift = float(rng.uniform(-50e-6, 50e-6))
        self._origin = int(rng.integers(0, 1 << 50))
        self._arrived_origin = self._origin  # of the events that have arrived
        self._packets = Delayed(about.camera_delay_us, about.stalls)

    def _return(self) -> None:
        """Begin another clock, which goes on later than the one before, as ``ReturningSource`` makes it."""
        self._origin += int(self._rng.integers(1000, 5_000_000))
        self._packets = Delayed(self._about.camera_delay_us, self._about.stalls)

    def time(self, world_us: float) -> int:
        """Return the camera's time of a simulated time [us]."""
        return self._origin + round(world_us * (1.0 + self._drift))

    def world_time(self, camera_us: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the simulated times of events that have arrived, by the camera's times [us], same shape."""
        return (camera_us - self._arrived_origin) / (1.0 + self._drift)

    def advance(self, now_us: int, pulses: Sequence[int]) -> list[Packet]:
        """Record the events of a step and the pulses in it; return the packets that have arrived by its end."""
        about, rng = self._about, self._rng
        returned = about.camera_returns_us // STEP_US == now_us // STEP_US
        if returned:
            self._return()
        pulled, plugged = about.trigger_cable
        seen = [at for at in pulses if not pulled <= at < plugged and rng.uniform() >= about.lost]
        triggers = np.array([self.time(at) + int(rng.integers(-1, 2)) for at in seen], np.int64)
        times = self.time(now_us) - np.array([STEP_US // 2, 1], np.int64)
        events = Events.from_arrays([1, 1], [1, 1], times, [1, 1])
        self._packets.put(now_us, (events, triggers, returned))
        found = []
        for given, edges, back in self._packets.arrived(now_us):
            found.append(replace(make_packet(HOST_US + now_us, given, edges), returned=back))
            self._arrived_origin = self._origin if back else self._arrived_origin
        return found


class Judge:
    """Compares each measured angle with the truth, once, as soon as it is known."""

    def __init__(self, encoder: EncoderStream, camera: SimulatedCamera, motor: Motor) -> None:
        self._encoder, self._camera, self._motor = encoder, camera, motor
        self._arrived_until = self._judged_until = -(2**62)
        self.measured = self.wrong = 0
        """Number of times [ms] with a measured angle, and with a wrong one."""
        self.worst_us = 0.0
        """Largest error of the time of a measured angle [us]."""

    def arrived(self, packet: Packet) -> None:
        """Take the times of a packet's events; after the camera's return, forget those of its clock before."""
        first, last = packet.events.t[[0, -1]].tolist()
        if packet.returned or self._judged_until < first - HELD_US:
            self._judged_until = first - STEP_US // 2
        self._arrived_until = last

    def judge(self) -> None:
        """Compare the angles of all events that have arrived and have got one since the last call."""
        encoder, last = self._encoder, self._encoder.last
        if last is None or encoder.first is None:
            return
        begin = max(self._judged_until + 1, self._arrived_until - HELD_US)
        times = np.arange(begin, min(last, self._arrived_until) + 1, 1000)
        if not len(times):
            return
        self._judged_until = min(last, self._arrived_until)
        times = times[~encoder.guessed(times)]
        if not len(times):
            return
        angle = encoder.over(int(times[0]), int(times[-1])).angle_at(times)
        difference = angle - self._motor.angle(self._camera.world_time(times))
        away_us = np.abs((difference + math.pi) % math.tau - math.pi) / (RPM / 60e6 * math.tau)
        self.measured += len(times)
        self.wrong += int(np.count_nonzero(away_us > WRONG_US))
        self.worst_us = max(self.worst_us, float(away_us.max()))


def run(seed: int, troubles: Troubles | None = None) -> Outcome:
    """Play one run, with the troubles of its seed by default."""
    about = draw(seed) if troubles is None else troubles
    rng = np.random.default_rng(seed + 1_000_000)
    motor = Motor(RPM)
    controller = Controller(
        motor,
        counts_per_turn=65536,
        drift_ppm=about.drift_ppm,
        clock_start=int(rng.integers(WRAP - 20_000_000, WRAP)),
        sync_hz=10.0 if about.regular else None,
        faults=[EmulatedFault.parse(text) for text in about.faults],
        seed=seed,
    )
    link = SimulatedLink(controller, Delayed(about.serial_delay_us, about.stalls))
    camera = SimulatedCamera(about, rng)
    encoder = EncoderStream(capacity=1 << 17)
    messages: list[str] = []
    feed = EncoderFeed(link, encoder, lambda *_: None, messages.append)  # type: ignore[arg-type]
    judge = Judge(encoder, camera, motor)
    sent_until = -1
    paired_s: float | None = None
    errors: list[float] = []
    jumps = any(fault.startswith("clock-jump") for fault in about.faults)
    for now in range(STEP_US, round(about.seconds * 1e6) + 1, STEP_US):
        link.advance(now)
        pulses = [at for _, at in list(controller.pulses) if sent_until < at <= now]
        sent_until = max([sent_until, *pulses])
        for packet in camera.advance(now, pulses):
            feed.take(packet)
            judge.arrived(packet)
        for _ in range(3):  # an update for each restart that waits
            feed.poll()
        judge.judge()
        if feed.clock is not None and feed.clock_source is ClockSource.PULSES:
            paired_s = now * 1e-6 if paired_s is None else paired_s
            if jumps:
                continue
            world_us = float(controller.time_at(feed.clock.at_us))
            error_us = int(feed.clock(feed.clock.at_us)) - camera.time(world_us)
            # The controller's clock wraps
            errors.append(abs((error_us + WRAP // 2) % WRAP - WRAP // 2))
    return Outcome(
        seed=seed,
        wrong=judge.wrong,
        worst_us=judge.worst_us,
        measured=judge.measured / (about.seconds * 1e3),
        paired_s=paired_s,
        error_us=float(np.median(errors)) if errors else None,
        messages=tuple(messages),
    )


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the figures of all runs."""
    paired = [one.paired_s for one in outcomes if one.paired_s is not None]
    errors = [one.error_us for one in outcomes if one.error_us is not None]
    return {
        "runs": len(outcomes),
        "wrong_runs": sum(one.wrong > 0 for one in outcomes),
        "worst_us": max(one.worst_us for one in outcomes),
        "paired_runs": len(paired),
        "seconds_until_paired": {"median": float(np.median(paired)), "longest": max(paired)}
        if paired
        else None,
        "error_at_pulses_us": {"median": float(np.median(errors)), "largest": max(errors)}
        if errors
        else None,
        "measured_share": {"median": float(np.median([one.measured for one in outcomes]))},
    }


def main() -> None:
    """Read the command line, play the runs, and print the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first run")
    parser.add_argument("--out", type=Path, help="file of all runs with their troubles")
    given = parser.parse_args()
    outcomes = [run(seed) for seed in track(range(given.seed, given.seed + given.runs))]
    figures = summary(outcomes)
    print(json.dumps(figures, indent=1))
    for one in outcomes:
        if one.wrong:
            print(
                f"wrong: seed {one.seed}, {one.wrong} ms, up to {one.worst_us:.0f} us: {draw(one.seed)}"
            )
    if given.out:
        rows = [{**asdict(draw(one.seed)), **asdict(one)} for one in outcomes]
        given.out.write_text(json.dumps({**figures, "rows": rows}, indent=1) + "\n")
    raise SystemExit(figures["wrong_runs"] > 0)


if __name__ == "__main__":
    main()
