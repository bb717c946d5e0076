"""Speeds that the core holds with a simulated hollow-shaft motor and an AS5047P: ``python gimbal.py``.

For each speed it prints what the prism does and what the host reads. It ends with status 1 if a fault stops the motor,
or a mean speed is off by more than :data:`MOST_OFF`, at a speed that the motor can reach.
"""

from __future__ import annotations

import ctypes
import math
import sys
from dataclasses import dataclass
from pathlib import Path

from boards import BUILD, NativeBoard

SPEEDS = (30.0, 60.0, 120.0, 240.0, 480.0, 720.0, 960.0, 1200.0, 1440.0)
"""Commanded speeds [turns/min]."""
MOST_OFF = 0.01
"""Largest error of the mean speed of a speed that is called held, relative."""


@dataclass(frozen=True)
class Held:
    """What a commanded speed led to."""

    rpm: float
    mean_rpm: float
    ripple: float
    """Rms deviation of the speed, relative to its mean."""
    angle_deg: float
    """Largest error of the angle that the host reads, besides a constant [deg of the prism]."""
    over: float
    """Overshoot, relative to the speed."""
    faults: int

    @property
    def held(self) -> bool:
        """Whether the speed was reached and no fault came."""
        return self.faults == 0 and abs(self.mean_rpm / self.rpm - 1.0) <= MOST_OFF


def hold(
    drive: object,
    rpm: float,
    *,
    seconds: float = 4.0,
    seed: int = 1,
    library: Path = BUILD / "libboard.so",
) -> Held:
    """Simulate a start from rest and some seconds at a speed; ``drive`` is a :class:`rig.drive.Drive`."""
    from amiwarp.live.link.protocol import (
        ControllerStatus,
        FrameDecoder,
        Ping,
        Samples,
        SetSpeed,
        encode,
    )
    from rig.drive import COUNTS, RATIO

    per_turn = COUNTS * RATIO
    board = NativeBoard(magnetic=True, counts_per_turn=per_turn, seed=seed, library=library)
    gains = (ctypes.c_int32 * 6)(*drive.gains.values())
    board.library.board_tune(board._board, gains)
    for name, value in drive.simulated.items():
        board.set(name, value)
    decoder = FrameDecoder()
    decoder.feed(board.advance(board.now + 100_000))
    board.feed(encode(SetSpeed(rpm, 1000.0), 0), board.now)
    speeds, turned, counted = [], {}, {}
    faults = 0
    settle = 1.5 + rpm / 1000.0
    steps = round(1000 * (settle + seconds))
    start = board.now
    for k in range(steps):
        if k % 500 == 0:
            board.feed(encode(Ping(k), k), board.now)
        data = board.advance(start + 1000 * (k + 1))
        speeds.append(board.get("rpm"))
        turned[board.now] = board.get("angle")
        for _, message in decoder.feed(data):
            if isinstance(message, Samples):
                counted.update(zip(message.t_us, message.count, strict=True))
            elif isinstance(message, ControllerStatus):
                faults |= message.faults
    late = speeds[round(1000 * settle) :]
    mean = sum(late) / len(late)
    ripple = math.sqrt(sum((v - mean) ** 2 for v in late) / len(late)) / mean if mean else math.inf
    after = start + round(1e6 * settle)
    errors = [
        math.tau * counted[t] / per_turn - turned[t] for t in counted if t in turned and t > after
    ]
    off = math.degrees(max(errors) - min(errors)) / 2.0 if errors else math.inf
    return Held(rpm, mean, ripple, off, max(speeds) / rpm - 1.0, faults)


def row(found: Held) -> str:
    """Return a speed as a row of the table."""
    cells = (
        f"{found.rpm:g}",
        f"{found.mean_rpm:.1f}",
        f"{100 * found.ripple:.2f}",
        f"{found.angle_deg:.2f}",
        f"{100 * found.over:.0f}",
        "yes" if found.held else f"no, faults {found.faults:#x}",
    )
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Print a line for each speed."""
    from rig.drive import drive_of, text
    from rig.gimbal import GIMBAL

    drive = drive_of(GIMBAL)
    print("\n".join(text(drive)))
    head = (
        "commanded [rpm]",
        "mean [rpm]",
        "ripple, rms [%]",
        "angle off by [deg]",
        "overshoot [%]",
        "held",
    )
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    wrong = False
    for rpm in SPEEDS:
        found = hold(drive, rpm)
        print(row(found), flush=True)
        wrong |= not found.held and rpm < 0.9 * drive.fastest
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
