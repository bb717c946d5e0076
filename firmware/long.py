"""Run an image in its simulator for minutes, and count losses: ``python long.py IMAGE SECONDS RPM COUNTS_PER_TURN``.

Ends with status 1 after a damaged or lost frame, a lost sample, a fault, or an index pulse latched more than 2 us late.
"""

import sys
from pathlib import Path

import numpy as np
from boards import make

from amiwarp.live.link.protocol import (
    ControllerStatus,
    FrameDecoder,
    Index,
    Ping,
    Samples,
    SetSpeed,
    encode,
)


def main(image: Path, seconds: float, rpm: float, counts_per_turn: int) -> bool:
    """Run, print the results and return whether all is well."""
    board, decoder = make(str(image), counts_per_turn), FrameDecoder()
    number, sent = 1, 0
    samples, gaps, last, faults = 0, 0, None, 0
    pulses: list[int] = []
    speeds: list[float] = []
    board.feed(encode(SetSpeed(rpm, 500.0), 0), board.now)
    while board.now < seconds * 1e6:
        data = board.advance(board.now + 10_000)
        sent += len(data)
        for _, message in decoder.feed(data):
            if isinstance(message, Samples):
                samples += len(message.t_us)
                for t in message.t_us:
                    gaps += last is not None and not 900 < (t - last) % (1 << 32) < 1100
                    last = t
            elif isinstance(message, Index):
                pulses.append(message.t_us)
            elif isinstance(message, ControllerStatus):
                faults |= message.faults
                speeds += [message.rpm] if board.now > 0.2e6 * seconds else []
        if board.now >= number * 1_000_000:
            board.feed(encode(Ping(number), number % 65536), board.now)
            number += 1
            if number % 60 == 0:
                print(f"{board.now / 1e6:.0f} s: {decoder.received}", flush=True)
    received, true = decoder.received, np.array(board.get("index_us"))
    late = (
        np.array(pulses) - true[: len(pulses)]
        if pulses and "MAGNETIC" not in image.name
        else np.zeros(1)
    )
    cycles, interrupts = board.get("cycles"), board.interrupts()
    board.close()
    print(
        f"{board.now / 1e6:.0f} s at {np.mean(speeds):.1f} rpm (status, deviation {np.std(speeds):.1f} rpm): {received}"
    )
    print(
        f"{samples:,} samples, {gaps} gaps, {sent / board.now * 1e6:.0f} bytes/s, faults {faults:#x}"
    )
    print(
        f"{len(pulses)} index pulses, latched {late.min():.2f} to {late.max():.2f} us after the edge"
    )
    for name, measured in interrupts.items():
        print(f"interrupt {name} [cycles]: {measured}")
    total = board.now * board.MHZ
    share = sum(measured["busy"] for measured in interrupts.values()) / total
    print(f"{cycles / total:.1%} of the cycles were used, {share:.1%} by interrupts")
    good = received.damaged + received.lost + received.unknown + gaps + faults == 0
    return good and samples > 990 * seconds and late.max() <= 2.0


if __name__ == "__main__":
    sys.exit(not main(Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])))
