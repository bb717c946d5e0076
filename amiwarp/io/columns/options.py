"""What the user says of a file's columns: the options ``--columns``, ``--time-unit``, ``--polarity`` and so on."""

import re
from dataclasses import dataclass, fields

from amiwarp.errors import AmiwarpError
from amiwarp.io.columns.names import ROLES
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import instance, whole

TIME_UNITS = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
"""Factors of the units of time to microseconds."""


@dataclass(frozen=True, slots=True)
class GivenLayout:
    """What the user says of a file's columns."""

    columns: str | None = None
    """Columns of t, x, y and p: ``t=ts,x=xs,y=ys,p=ps``, or for columns without names their order ``x,y,p,t``."""
    time_unit: str | None = None
    """Unit of time: one of :data:`TIME_UNITS`."""
    polarity: str | None = None
    """Values of the polarity: ``1=on,2=off``."""
    scale_xy: int | None = None
    """Number by which x and y are divided."""

    @property
    def options(self) -> str:
        """Names of the options that are given."""
        names = [option.name for option in fields(self) if getattr(self, option.name) is not None]
        return ", ".join("--" + name.replace("_", "-") for name in names)

    def check(self) -> None:
        """Raise :class:`AmiwarpError` for a value that is none."""
        for name in ("columns", "time_unit", "polarity"):
            if getattr(self, name) is not None:
                instance(getattr(self, name), str, name)
        if self.scale_xy is not None:
            whole(self.scale_xy, "--scale-xy", 1, LARGEST_SIZE)
        if self.time_unit is not None and self.time_unit not in TIME_UNITS:
            raise AmiwarpError(
                f"--time-unit {self.time_unit!r} is unknown; choose among {', '.join(TIME_UNITS)}"
            )
        if self.columns is not None:
            given_roles(self.columns)
        if self.polarity is not None:
            given_polarity(self.polarity)


def given_roles(text: str) -> dict[str, str]:
    """Return the name or the number, from 1 on, of the column of each role in the option ``--columns``."""
    words = [word.strip() for word in text.split(",")]
    if not any("=" in word for word in words):
        words = [f"{word}={number}" for number, word in enumerate(words, 1) if word != "-"]
    roles: dict[str, str] = {}
    for word in words:
        role, _, name = word.partition("=")
        roles[role.strip()] = name.strip()
    if sorted(roles) != sorted(ROLES) or len(words) != len(ROLES) or not all(roles.values()):
        raise AmiwarpError(
            f"--columns {text!r} does not name t, x, y and p once each; write t=NAME,x=NAME,y=NAME,p=NAME, or their "
            "order in the file, such as x,y,p,t (- for a column without use)"
        )
    return roles


def given_polarity(text: str) -> dict[int, bool]:
    """Return for each value in the option ``--polarity`` whether it is ON."""
    is_on: dict[int, bool] = {}
    for word in text.split(","):
        value, _, meaning = (part.strip().lower() for part in word.partition("="))
        if not re.fullmatch(r"-?\d{1,20}", value) or meaning not in ("on", "off"):
            raise AmiwarpError(
                f"--polarity {text!r} is not a list of values; write it like 1=on,2=off"
            )
        if is_on.setdefault(int(value), meaning == "on") != (meaning == "on"):
            raise AmiwarpError(
                f"--polarity {text!r} says both on and off of {value}; give each value once"
            )
    return is_on
