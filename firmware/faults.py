"""Simulated faults of the core's motor, encoder, index, magnet, supply, load, link and reset, alone and in pairs.

``python faults.py [NUMBER] [FIRST]`` simulates as many cases, one for each seed from FIRST on. It ends with status 1 if
in a case the prism exceeded :data:`MOST_RPM`, or the motor had voltage for more than :data:`MOST_UNFED_US` while its
encoder did not move, or had no magnet.
"""

from __future__ import annotations

import random
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from boards import BUILD, NativeBoard

MOST_RPM, MOST_UNFED_US = 3000.0, 100_000
"""Largest speed [turns/min] and longest time of voltage without counts [us] that a fault may lead to."""
FASTEST_COMMAND = 1440.0
SETTINGS: tuple[dict[str, Any], ...] = (
    {}, {"counts_per_turn": 1000}, {"magnetic": True}, {"magnetic": True, "counts_per_turn": 32768},
)  # fmt: skip
LASTING = (
    "dead_encoder",
    "dead_a",
    "bad_spi",
    "no_magnet",
    "no_index",
    "jammed",
    "no_supply",
    "sensed_supply",
)
PARTS = {
    "lost_counts": (0.05, 0.95),
    "load": (200.0, 8000.0),
    "heavy": (-0.5, 3.0),
    "bad_spi_at_random": (0.01, 0.5),
}
KINDS = (
    *LASTING,
    *PARTS,
    "bouncing_index",
    "odd_index",
    "error_flag",
    "driver_fault",
    "noisy_link",
    "silent_host",
    "reset",
    "other_speed",
)
"""Kinds of faults. Wires of the motor that are exchanged do so before the start, see :class:`Case`."""


@dataclass(frozen=True)
class Case:
    """What happens in one case."""

    settings: dict[str, Any]
    rpm: float
    ramp: float
    faults: tuple[tuple[str, float, float, float], ...]
    """Name, begin and end [s], and size of each fault."""
    reversed_motor: bool

    @property
    def name(self) -> str:
        """The faults, in order of their names."""
        names = {name for name, *_ in self.faults}
        return " + ".join(sorted(names | {"reversed_motor"} if self.reversed_motor else names))


@dataclass(frozen=True)
class Outcome:
    """What a case led to."""

    fastest_rpm: float
    unfed_us: float
    driven: bool
    """Whether the motor has voltage at the end."""

    @property
    def safe(self) -> bool:
        """Whether the limits of speed and of voltage without counts were kept."""
        return self.fastest_rpm <= MOST_RPM and self.unfed_us <= MOST_UNFED_US


def drawn(seed: int) -> Case:
    """Return the case of a seed: one fault, or two in every second case."""
    rng = random.Random(seed)
    rpm = rng.choice((-1.0, 1.0)) * rng.choice((60.0, 120.0, 300.0, 720.0, 1000.0, FASTEST_COMMAND))
    faults = []
    for _ in range(1 + seed % 2):
        name = rng.choice(KINDS)
        begin = rng.choice((0.0, rng.uniform(0.0, 3.0)))
        end = rng.choice((9.0, begin + rng.choice((0.001, 0.02, 0.1, 0.5, 2.0))))
        faults.append((name, begin, end, rng.uniform(*PARTS.get(name, (0.0, 1.0)))))
    ramp = rng.choice((120.0, 500.0, 2000.0, 1e5))
    return Case(rng.choice(SETTINGS), rpm, ramp, tuple(faults), reversed_motor=rng.random() < 0.03)


def run(case: Case, seed: int, library: Path = BUILD / "libboard.so") -> Outcome:
    """Simulate 5 s of a case: set the speed, change it once, and reset or disturb the link as the faults say."""
    from amiwarp.live.link.protocol import Ping, SetSpeed, Stop, encode

    rng = random.Random(seed + 1)
    board = NativeBoard(library=library, seed=seed, pulses=seed % 2, **case.settings)
    board.set("reversed_motor", float(case.reversed_motor))
    edges = [(begin, name, size) for name, begin, _, size in case.faults]
    waiting = sorted([*edges, *((end, name, 0.0) for name, _, end, _ in case.faults)])
    active: set[str] = set()
    commanded = False
    for step in range(250):
        now = step * 0.02
        while waiting and waiting[0][0] <= now:
            _, name, size = waiting.pop(0)
            (active.add if size else active.discard)(name)
            switch(board, name, size)
            if name == "other_speed" and size:
                board.feed(
                    encode(SetSpeed(rng.uniform(-FASTEST_COMMAND, FASTEST_COMMAND), 2000.0), 0),
                    board.now,
                )
        if not commanded and now >= 0.1:
            board.feed(encode(SetSpeed(case.rpm, case.ramp), step), board.now)
            commanded = True
        if step == 225:
            board.feed(encode(Stop(), step), board.now)
        data = encode(Ping(step), step)
        if "noisy_link" in active:
            data = bytes(
                b ^ 1 << rng.randrange(8) if rng.random() < 0.05 else b for b in data
            ) + rng.randbytes(40)
        if "silent_host" not in active:
            board.feed(data, board.now)
        board.advance(board.now + 20_000)
    return Outcome(board.get("fastest_rpm"), board.get("unfed_us"), bool(board.get("driven")))


def switch(board: NativeBoard, name: str, size: float) -> None:
    """Begin a fault of a size, or end it with size 0."""
    on = float(size != 0)
    if name == "reset":
        if on:
            board.reset()
    elif name == "error_flag":
        board.set(name, 40.0 * size if on else 0.0)
    elif name == "sensed_supply":
        board.set("sensed", on)
        board.set("no_supply", on)
    elif name == "bad_spi_at_random":
        board.set("bad_spi", size)
    elif name in PARTS:
        board.set(name, size)
    elif name not in ("noisy_link", "silent_host", "other_speed"):
        board.set(name, on)


def main() -> int:
    """Simulate the cases and print the numbers by kind of fault."""
    number, first = (int(text) for text in (*sys.argv[1:3], *("10000", "0")[len(sys.argv) - 1 :]))
    kinds: Counter[str] = Counter()
    bad = 0
    fastest = longest = 0.0
    for seed in range(first, first + number):
        case = drawn(seed)
        outcome = run(case, seed)
        kinds.update(case.name.split(" + "))
        fastest, longest = max(fastest, outcome.fastest_rpm), max(longest, outcome.unfed_us)
        if not outcome.safe:
            bad += 1
            print(
                f"seed {seed}: {outcome.fastest_rpm:.0f} rpm, {outcome.unfed_us / 1000:.0f} ms: {case}",
                flush=True,
            )
        if (seed - first) % 1000 == 999:
            print(f"{seed - first + 1} of {number}", file=sys.stderr, flush=True)
    for name, count in sorted(kinds.items()):
        print(f"{name}: {count}")
    print(
        f"{number} cases, {bad} beyond the limits; at most {fastest:.0f} rpm and {longest / 1000:.0f} ms without counts"
    )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
