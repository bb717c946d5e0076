"""Camera, motor and encoder: ``amiwarp live``, ``record``, ``motor`` and ``emulate``, the rig's emulator."""

from amiwarp.live.commands.emulate import run_emulate
from amiwarp.live.commands.live import run_live
from amiwarp.live.commands.motor import run_motor
from amiwarp.live.commands.record import run_record

__all__ = ["run_emulate", "run_live", "run_motor", "run_record"]
