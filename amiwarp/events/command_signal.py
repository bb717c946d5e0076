"""Angles of a command signal that swings to and fro, or goes in steps, such as one of a mirror."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.validation import array, as_times, real

Integers = NDArray[np.int64]
Vector = NDArray[np.float64]

LONGEST_TURN = 0.35
"""Longest step of the angle of a command at the end of a swing that is taken for the way through its largest magnitude
[rad]; longer ones are jumps."""


def command_samples(t_us: ArrayLike, command: ArrayLike) -> tuple[Integers, Vector]:
    """Return times and commands, of one length; raise :class:`AmiwarpError` for others, and if they are not finite."""
    t = as_times(t_us)
    commands = array(command, "command").astype(np.float64)
    if commands.shape != t.shape or t.ndim != 1:
        raise AmiwarpError(
            f"command has shape {commands.shape}, its times {t.shape}; give one value for each time"
        )
    finite = np.isfinite(commands)
    if not finite.all():
        raise AmiwarpError(
            f"command is {commands[~finite][0]}, which is not finite; leave that sample out"
        )
    return t, commands


class CommandAngles:
    """Makes the angles of :meth:`Encoder.from_command` of a command that comes in parts.

    The angle of a sample depends on the direction of the command before and after it. The last sample of each part
    therefore waits for the next part.
    """

    def __init__(self) -> None:
        # Time [us] and command of the sample that waits, if any.
        self._t = np.zeros(0, np.int64)
        self._command = np.zeros(0)
        self._before: tuple[int, bool] | None = None
        """Number of swings up to the interval before that sample, and whether the command rose in it."""

    @property
    def last(self) -> int | None:
        """Time of the latest sample [us]; None before the first."""
        return int(self._t[0]) if self._t.size else None

    def take(
        self,
        t: Integers,
        command: Vector,
        largest: float,
        *,
        end: bool = False,
    ) -> tuple[Integers, Vector]:
        """Take samples with ascending times [us], shape (n,); return times and angles [rad] of those that are ready.

        ``largest``: largest magnitude of the command. ``end``: whether no part follows. Raises :class:`AmiwarpError`
        for a command beyond ``largest``.
        """
        largest = real(largest, "largest command")
        if not largest > 0.0:
            raise AmiwarpError(f"largest command is {largest:g}; give a number above 0")
        beyond = np.abs(command) > largest
        if beyond.any():
            raise AmiwarpError(
                f"command is {command[beyond][0]:g}, larger than the largest, {largest:g}; give the largest magnitude "
                "that the command ever takes"
            )
        t = np.concatenate([self._t, t])
        command = np.concatenate([self._command, command])
        if t.size < 2:
            self._t = t
            self._command = command
            return t[:0], command[:0]

        turns, rising = self._swings(command)
        turns_before, rose_before = self._before or (int(turns[0]), bool(rising[0]))
        ready = t.size if end else t.size - 1
        self._t = t[ready:]
        self._command = command[ready:]
        self._before = (int(turns[-1]), bool(rising[-1]))

        # Each sample has an interval before and one after it: intervals k and k + 1.
        turns = np.append(turns_before, turns)
        rising = np.append(rose_before, rising)
        if end:
            turns = np.append(turns, turns[-1])
            rising = np.append(rising, rising[-1])
        angle = np.arccos(command / largest)[:ready]
        before = _unwrapped(angle, turns[:ready], rising[:ready])
        after = _unwrapped(angle, turns[1 : ready + 1], rising[1 : ready + 1])
        next_t = np.append(t[1:], t[-1])
        return _with_jumps(t[:ready], next_t[:ready], before, after)

    def _swings(self, command: Vector) -> tuple[Integers, NDArray[np.bool_]]:
        """Return for each interval between samples the number of swings so far, and whether the command rises in it."""
        turns, rose = self._before or (0, False)
        rises = np.sign(np.diff(command))
        # A command that pauses keeps its direction: the direction of the last interval in which it moved.
        moved = np.where(rises != 0.0, np.arange(len(rises)), -1)
        last_moved = np.maximum.accumulate(moved)
        rising = np.where(last_moved < 0, rose, rises[last_moved] > 0.0)
        rose_before = np.append(rose, rising[:-1])
        peaks = rose_before & ~rising
        return turns + np.cumsum(peaks), rising


def _unwrapped(angle: Vector, turns: Integers, rising: NDArray[np.bool_]) -> Vector:
    """Return the angles [rad] after a number of turns; the second half of a turn is the one in which commands rise."""
    turned = np.where(rising, math.tau - angle, angle)
    return np.asarray(math.tau * turns + turned, np.float64)


def _with_jumps(
    t: Integers,
    next_t: Integers,
    before: Vector,
    after: Vector,
) -> tuple[Integers, Vector]:
    """Return times [us] and angles of samples, by the angles of the swings before and after each of them [rad].

    Where a swing ends before the largest magnitude, the angle jumps: a second sample follows 1 us later, unless the
    next one is there.
    """
    jumps = after - before > LONGEST_TURN
    at_samples = np.where(jumps, before, (before + after) / 2.0)
    followed = jumps & (next_t > t + 1)
    times = np.concatenate([t, t[followed] + 1])
    angles = np.concatenate([at_samples, after[followed]])
    order = np.argsort(times, kind="stable")
    return times[order], angles[order]
