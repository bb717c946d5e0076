"""What a brushless motor with a hollow shaft does with the prism: speed, torque, ripple, and errors of its encoder.

The driver commutates sinusoidally and takes the voltage as PWM, so the motor is a DC motor to the firmware:
V = R I + K ω and T = K I, with K = 60 / (2π KV). All of it is computed or simulated; nothing was measured.
"""

import math
from dataclasses import dataclass

from rig import numbers
from rig.gimbal import GimbalRig, HollowMotor

SUPPLY = 12.0
"""Voltage of the supply [V]."""
RATIO = 2
"""Turns of the encoder's magnet per turn of the prism."""
COUNTS = 16384
"""Counts of the AS5047P per turn of its magnet."""
INL, NOISE = 0.8, 0.068
"""Non-linearity (largest, magnet well placed) and rms noise of an AS5047P [deg of the magnet]."""
FULL_DUTY, CROSSOVER, PER_INTEGRAL = 32767, 16.0, 5.0
"""Duty of the firmware at full voltage; speed of its control [rad/s], and its integral gain by its proportional one
[1/s]: as with its default gains and motor."""


@dataclass(frozen=True)
class Drive:
    """A motor with what it turns."""

    motor: HollowMotor
    inertia: float
    """Moment of inertia about the axis [kg m²]."""

    @property
    def constant(self) -> float:
        """Torque by current [N m/A], and voltage by angular speed [V s]."""
        return 60.0 / (math.tau * self.motor.kv)

    @property
    def no_load(self) -> float:
        """Speed at the supply's voltage without friction [turns/min]."""
        return self.motor.kv * SUPPLY

    @property
    def rise(self) -> float:
        """Time in which it reaches 63 % of its speed, were the current not limited [s]."""
        return self.inertia * self.motor.resistance / self.constant**2

    @property
    def torque(self) -> float:
        """Torque at the current limit [N m]."""
        return self.constant * self.motor.current

    @property
    def fastest(self) -> float:
        """Speed against its friction [turns/min]; 0 if it does not turn at all."""
        friction = self.motor.friction * 1e-3
        if friction >= self.torque:
            return 0.0
        return max(
            0.0, self.no_load * (1.0 - friction * self.motor.resistance / (self.constant * SUPPLY))
        )

    @property
    def cogs(self) -> int:
        """Periods of the cogging torque per turn."""
        return math.lcm(self.motor.slots, self.motor.poles)

    def rpm_s(self, torque: float) -> float:
        """Return the acceleration by a torque [N m], in turns/min per second."""
        return torque / self.inertia * 60.0 / math.tau

    def ripple(self, rpm: float) -> float:
        """Return the amplitude of the speed's ripple by cogging, relative to the speed: T / (J N ω²)."""
        return self.motor.cogging * 1e-3 / (self.inertia * self.cogs * numbers.omega(rpm) ** 2)

    def wander(self, rpm: float) -> float:
        """Return the amplitude of the prism's angle by cogging [deg]: T / (J N² ω²)."""
        return math.degrees(self.ripple(rpm) / self.cogs)

    @property
    def gains(self) -> dict[str, int]:
        """Gains of the firmware, in the order of ``struct gains``. ``duty_slew`` is the built one, and no setting."""
        per_rpm = FULL_DUTY / self.no_load
        proportional = CROSSOVER * self.rise * per_rpm
        friction = self.motor.friction * 1e-3 * self.motor.resistance / (self.constant * SUPPLY)
        return {
            "no_load_rpm": round(self.no_load),
            "friction": round(friction * FULL_DUTY),
            "kp": round(256 * proportional),
            "ki": round(256 * proportional * PER_INTEGRAL),
            "rise_ms": round(1e3 * self.rise),
            "duty_slew": 1500,
        }

    @property
    def simulated(self) -> dict[str, float]:
        """Values for the simulated motor of ``firmware/native/motor.h``, by their names in ``firmware/boards.py``."""
        per_deg = COUNTS / 360.0
        return {
            "no_load_rpm": self.no_load,
            "rise_s": self.rise,
            "cogging": self.rpm_s(self.motor.cogging * 1e-3),
            "cogs": float(self.cogs),
            "friction": self.rpm_s(self.motor.friction * 1e-3),
            "most_pull": self.rpm_s(self.torque),
            "noise": math.sqrt(3.0) * NOISE * per_deg,  # uniform, with the rms of the data sheet
            "inl": INL * per_deg / 1.4,  # the sum of both waves is at most 1.4 times the first
        }


def drive_of(rig: GimbalRig) -> Drive:
    """Return the motor of a rig with the inertia of all that turns."""
    body = numbers.rotating(rig)
    return Drive(rig.hollow, float(body.inertia[2, 2]) * 1e-9)


def text(drive: Drive) -> list[str]:
    """Return the numbers that the command prints."""
    ripples = [f"{100.0 * drive.ripple(rpm):.2g} %" for rpm in numbers.SPEEDS]
    speeds = " / ".join(f"{rpm:g}" for rpm in numbers.SPEEDS)
    settings = {
        name.replace("_", "-"): value for name, value in drive.gains.items() if name != "duty_slew"
    }
    changes = " ".join(f"--change {name}={value}" for name, value in settings.items())
    return [
        f"motor: at most {drive.fastest:.0f} rpm at {SUPPLY:g} V (--kv {drive.motor.kv:g}, --resistance-ohm "
        f"{drive.motor.resistance:g}, --friction-mnm {drive.motor.friction:g}), {1e3 * drive.torque:.0f} mN m at "
        f"{drive.motor.current:g} A (--current-a)",
        f"inertia {1e9 * drive.inertia:.0f} g mm², time constant {1e3 * drive.rise:.0f} ms; cogging of "
        f"{drive.motor.cogging:g} mN m (--cogging-mnm), {drive.cogs} times a turn (--slots-poles), makes a ripple of "
        f"{' / '.join(ripples)} at {speeds} rpm",
        f"encoder: AS5047P on a shaft that turns {RATIO} times as fast, not linear to {INL / RATIO:g}° of the prism, "
        f"noise {NOISE / RATIO:.3f}° rms",
        f"gains of the firmware, from this: amiwarp motor settings {changes}",
        "motor and encoder are computed and simulated, never built: measure yours",
    ]
