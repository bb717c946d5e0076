"""Layout of files of plain columns: which column is which, the unit of time, and the coding of polarity.

All readers of text, NumPy, HDF5, MATLAB and Parquet files decide here. A layout is found from names, types and the
first values. What the file does not state is an :class:`~amiwarp.io.file_scan.Assumption`, which names the option that
overrides it. In doubt, :func:`find_layout` raises :class:`AmiwarpError`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue
from amiwarp.io.file_scan import Assumption, Packet, whole_pixels
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import TIME_LIMIT, instance, rounded_times, whole

# What is found, and what the user says of it.

ROLES = ("t", "x", "y", "p")
"""Columns of an event: time, column and row of the pixel, polarity."""

TIME_UNITS = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
"""Factors of the units of time to microseconds."""

SAMPLE = 1 << 16
"""Number of events from which a layout is found."""


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
        names = [each.name for each in fields(self) if getattr(self, each.name) is not None]
        return ", ".join("--" + name.replace("_", "-") for name in names)

    def check(self) -> None:
        """Raise :class:`AmiwarpError` for a value that is none."""
        for name in ("columns", "time_unit", "polarity"):
            if getattr(self, name) is not None:
                instance(getattr(self, name), str, name)
        if self.scale_xy is not None:
            whole(self.scale_xy, "--scale-xy", 1, LARGEST_SIZE)
        if self.time_unit is not None and self.time_unit not in TIME_UNITS:
            raise AmiwarpError(f"--time-unit {self.time_unit!r} is unknown; choose among {', '.join(TIME_UNITS)}")
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


def is_wanted(name: str, wanted: Collection[str]) -> bool:
    """Return whether a column of this name, with or without its groups, is among the wanted names."""
    return name in wanted or name.rpartition("/")[2] in wanted


def given_polarity(text: str) -> dict[int, bool]:
    """Return for each value in the option ``--polarity`` whether it is ON."""
    found: dict[int, bool] = {}
    for word in text.split(","):
        value, _, meaning = (part.strip().lower() for part in word.partition("="))
        if not re.fullmatch(r"-?\d{1,20}", value) or meaning not in ("on", "off"):
            raise AmiwarpError(f"--polarity {text!r} is not a list of values; write it like 1=on,2=off")
        found[int(value)] = meaning == "on"
    return found


# Names of columns.

NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps", "time_stamp", "time_stamps", "tstamp"),
    "x": ("x", "xs", "col", "cols", "column", "columns", "x_coord", "x_coordinate", "x_pos"),
    "y": ("y", "ys", "row", "rows", "y_coord", "y_coordinate", "y_pos"),
    "p": ("p", "ps", "pol", "pols", "polarity", "polarities", "on", "is_on"),
}
"""Names of each role, in lower case."""

UNIT_NAMES = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "millisecond", "milliseconds"),
    "us": ("us", "µs", "μs", "usec", "usecs", "microsecond", "microseconds"),
    "ns": ("ns", "nsec", "nsecs", "nanosecond", "nanoseconds"),
}
"""Names of the units of time, in lower case."""


def unit_of(text: str) -> str | None:
    """Return the unit of time of this name, or None."""
    return next((unit for unit, names in UNIT_NAMES.items() if text.strip().lower() in names), None)


def role_of(name: str) -> tuple[str | None, str | None]:
    """Return the role of a column of this name, and the unit of time in the name; None for what is unknown."""
    plain = re.split(r"[/.]", name.strip().strip("\"'").lower())[-1].strip()
    plain = re.sub(r"^(?:events?|evts?|ev|dvs)[_\s-]+", "", plain)
    for role, names in NAMES.items():
        if plain in names:
            return role, None
    match = re.fullmatch(r"(.+?)[\s_-]*[(\[{]([^)\]}]*)[)\]}]|(.+?)[_\s-]+(\S+)|(timestamps?|time)(\S+)", plain)
    if match is None:
        return None, None
    stem, suffix = match[1] or match[3] or match[5], match[2] or match[4] or match[6] or ""
    found = next((role for role, names in NAMES.items() if stem in names), None)
    unit = unit_of(suffix)
    if found == "t":
        return (found, unit) if unit else (None, None)
    return (found, None) if found in ("x", "y") and suffix in ("px", "pixel", "pixels") else (None, None)


RARE_NAMES = {
    "x": ("u", "colindex", "colidx", "columnindex", "xaddr", "xaddress", "addrx", "addressx", "xpos",
          "xposition", "posx", "positionx", "xcoord", "xcoords", "xcoordinate", "xcoordinates", "coordx",
          "coordinatex", "xidx", "xindex", "xpx", "xpixel", "pixelx", "pxx", "xloc", "locx"),
    "y": ("v", "rowindex", "rowidx", "yaddr", "yaddress", "addry", "addressy", "ypos", "yposition", "posy",
          "positiony", "ycoord", "ycoords", "ycoordinate", "ycoordinates", "coordy", "coordinatey", "yidx",
          "yindex", "ypx", "ypixel", "pixely", "pxy", "yloc", "locy"),
    "p": ("onoff", "offon", "sign", "signs", "sgn", "polar", "positive", "ispositive", "isonevent",
          "polaritybool", "polbool", "polaritybinary", "polaritysign", "polaritysigned", "polarityvalue",
          "polarity01", "pol01", "polarityonoff", "onoffpolarity"),
}  # fmt: skip
"""Names that stand for a role where no column has one of :data:`NAMES`: in lower case, of letters and digits only."""

_UNIT_PATTERN = "|".join(sorted((name for names in UNIT_NAMES.values() for name in names), key=len, reverse=True))
RARE_TIME = re.compile(
    r"(?P<stem>t|ts|times?|(?:time)?stamps?|timestamps?|tstamp|epochs?|unix|unixtime|unixtimestamp|utc|utctime|abstime|"
    r"reltime|trel|elapsed|elapsedtime|timeelapsed|eventtimes?|datetimes?|dates?)?(?:in)?"
    rf"(?P<unit>{_UNIT_PATTERN})?"
)
"""Pattern of such names of times, with or without a unit: a unit alone is the name of a time, too."""


def _rare_role_of(name: str) -> tuple[str | None, str | None]:
    """Return the role of a column with one of :data:`RARE_NAMES`, and the unit of time in it."""
    plain = re.split(r"[/.]", name.lower())[-1]
    plain = re.sub(r"^\W*(?:events?|evts?|ev|dvs)[_\s-]+", "", plain)
    plain = re.sub(r"[\W_]+", "", plain)
    for role, names in RARE_NAMES.items():
        if plain in names:
            return role, None
    match = RARE_TIME.fullmatch(plain)
    if match is None or plain in ("", "s", "in"):
        return None, None
    return "t", unit_of(match["unit"] or "")


def unit_in(name: str) -> str | None:
    """Return the unit of time in the name of a column, or None."""
    role, unit = role_of(name)
    return _rare_role_of(name)[1] if role is None else unit


def roles_of(names: Sequence[str]) -> dict[str, list[int]]:
    """Return for each role the indices of the columns that can have it by their names.

    Columns with :data:`RARE_NAMES` count only for a role that no other column has, and for x and y only together: next
    to x, v is a speed. But a time in whole seconds may have its fractions in another column.
    """
    common = [role_of(name) for name in names]
    rare = [_rare_role_of(name) for name in names]
    found = {role: [at for at, (known, _) in enumerate(common) if known == role] for role in ROLES}
    others = {
        role: [at for at, (known, _) in enumerate(rare) if known == role and common[at][0] is None] for role in ROLES
    }
    if [common[at][1] for at in found["t"]] == ["s"]:
        found["t"] += [at for at in others["t"] if rare[at][1] not in (None, "s")]
    found["t"] = found["t"] or others["t"]
    found["p"] = found["p"] or others["p"]
    if not found["x"] and not found["y"]:
        found["x"], found["y"] = others["x"], others["y"]
    return found


def names_roles(names: Iterable[str]) -> bool:
    """Return whether a file's columns of these names hold events."""
    return all(roles_of(list(names)).values())


def example_of_columns(names: Iterable[str]) -> str:
    """Return an example of the option ``--columns`` with names of this file, and NAME for what none is named as.

    Of names with groups, those of the group with the most roles are taken.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(name.rpartition("/")[0], []).append(name)
    best: dict[str, str] = {}
    for members in groups.values():
        found = {role: members[places[0]] for role, places in roles_of(members).items() if places}
        best = found if len(found) > len(best) else best
    return ",".join(f"{role}={best.get(role, 'NAME')}" for role in ROLES)


# The layout.


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a file."""

    name: str | None
    """Its name, or None."""
    values: NDArray[Any]
    """Its first values, up to :data:`SAMPLE` of them."""
    unit: str | None = None
    """Unit of time that the file states for it, or None."""


@dataclass(frozen=True, slots=True)
class Hints:
    """What a format promises, or a file states elsewhere."""

    order: tuple[str, ...] | None = None
    """Order of columns without names, if the format promises it."""
    unit: str | None = None
    """Unit of time that the format promises."""
    fractions: str | None = None
    """Unit of times with fractions that the format promises."""
    compensated: bool = False
    """Whether x and y with fractions are those of compensated events."""
    is_text: bool = False
    """Whether the file is text, which OpenMV does not write."""
    is_own: bool = False
    """Whether the layout is amiwarp's own in all details, so that its promised unit is believed for any rate."""


Coding: TypeAlias = Mapping[int, bool]
"""For each value of the polarity whether it is ON."""

ZERO_OR_ONE: Coding = {0: False, 1: True}
SIGNED: Coding = {-1: False, 0: False, 1: True}
"""Codings that are known: 1 is ON, 0 or -1 is OFF."""
UNSIGNED_MINUS_ONE = (255, 2**16 - 1, 2**32 - 1, 2**64 - 1)
"""Values of -1 in unsigned integers."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Meaning of a file's columns."""

    columns: Mapping[str, int]
    """Index of the column of each role. The events of OpenMV have two further columns of time."""
    unit: str
    """Unit of time."""
    coding: Coding
    """Meaning of the values of the polarity."""
    scale: int = 1
    """Number by which x and y are divided."""
    compensated: bool = False
    """Whether fractions of x and y are kept."""
    assumptions: tuple[Assumption, ...] = ()
    """What the file does not state."""
    openmv: bool = False
    """Whether the columns are those of OpenMV: type, s, ms, us, x, y."""
    unit_is_assumed: bool = False
    """Whether the unit was inferred from whole numbers."""
    is_promised: bool = False
    """Whether the file has a documented layout, and nothing was assumed."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Name or number of the column of each role, for the metadata."""

    @property
    def chosen(self) -> tuple[int, ...]:
        """Indices of the columns that are read, in the order of :meth:`events`."""
        return tuple(self.columns.values())

    @property
    def metadata(self) -> dict[str, MetadataValue]:
        """Columns, unit and assumptions, for the metadata of a recording; empty for a layout that a format promises."""
        if self.is_promised:
            return {}
        columns = ", ".join(f"{role} = {name}" for role, name in self.names.items())
        return {"columns": columns, "time_unit": self.unit, **dict(each.entry for each in self.assumptions)}

    def events(self, *columns: NDArray[Any], notes: dict[str, int]) -> Packet:
        """Return the events of the columns in the order of :attr:`chosen`. Counts go to ``notes``."""
        if self.openmv:
            return self._openmv_events(columns, notes)
        return self.columns_of_events(*columns)

    def columns_of_events(
        self, t: NDArray[Any], x: NDArray[Any], y: NDArray[Any], p: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.int64], NDArray[np.uint8]]:
        """Return x, y [px], t [us] and p of the columns t, x, y and p."""
        return self.pixels(x), self.pixels(y), self.times(t), self.polarities(p)

    def times(self, t: NDArray[Any]) -> NDArray[np.int64]:
        """Return times [us]."""
        factor = TIME_UNITS[self.unit]
        if self.unit == "ns":
            return self._times_of_nanoseconds(t)
        if t.dtype.kind == "f":
            with np.errstate(over="ignore"):
                return rounded_times(t.astype(np.float64) * factor)
        if self.unit == "us":
            return rounded_times(t)
        if t.size and max(abs(int(t.min())), abs(int(t.max()))) * factor >= TIME_LIMIT:
            raise AmiwarpError(f"times reach {int(t.max())} {self.unit}, beyond int64 in us; the unit must be another")
        return t.astype(np.int64) * int(factor)

    def _times_of_nanoseconds(self, t: NDArray[Any]) -> NDArray[np.int64]:
        """Return times [us] of times [ns]: half a microsecond is rounded up, for integers and floating numbers."""
        if t.dtype.kind == "f":
            t = t.astype(np.float64)
        elif t.size and int(t.max()) >= 2**63:
            raise AmiwarpError(f"a time is {int(t.max())} ns, beyond int64; the file is damaged")
        else:
            t = t.astype(np.int64)
        with np.errstate(invalid="ignore"):  # times that are not finite, which are refused
            return rounded_times(t // 1000 + (t % 1000 >= 500))

    def pixels(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return coordinates [px]: integers, or floating ones of compensated events."""
        if self.compensated and values.dtype.kind == "f":
            return values / self.scale if self.scale > 1 else values
        whole = whole_pixels(values) if values.dtype.kind == "f" else values
        if self.scale == 1:
            return whole
        scaled, rest = np.divmod(whole, self.scale)
        if rest.any():
            raise AmiwarpError(
                f"a coordinate is {int(whole[rest != 0][0])}, no multiple of {self.scale}; give another --scale-xy"
            )
        return np.asarray(scaled)

    def polarities(self, p: NDArray[Any]) -> NDArray[np.uint8]:
        """Return polarities: 1 for ON, 0 for OFF. Raises :class:`AmiwarpError` for a value without a meaning."""
        if p.dtype == np.bool_:
            p = p.view(np.uint8)
        on, known = np.zeros(p.shape, np.bool_), np.zeros(p.shape, np.bool_)
        for value, is_on in self.coding.items():
            if _fits(value, p.dtype):
                here = p == value
                known |= here
                on |= here if is_on else False
        if not known.all():
            raise AmiwarpError(
                f"a polarity is {p[~known][0]}; expected {_listed(self.coding)}; say what it means with --polarity, "
                "such as 1=on,2=off"
            )
        return on.view(np.uint8)

    def _openmv_events(self, columns: Sequence[NDArray[Any]], notes: dict[str, int]) -> Packet:
        """Return the events of OpenMV's columns: type, s, ms, us, x, y. Types from 2 on are no events of pixels."""
        kind, seconds, milliseconds, microseconds, x, y = (values.astype(np.int64) for values in columns)
        t = seconds * 1_000_000 + milliseconds * 1000 + microseconds
        pixel = kind <= 1
        notes["other_records"] = notes.get("other_records", 0) + int(np.count_nonzero(~pixel))
        return x[pixel], y[pixel], t[pixel], kind[pixel]


def _fits(value: int, dtype: np.dtype[Any]) -> bool:
    """Return whether an array of this type can hold a value."""
    if dtype.kind == "f":
        return True
    about = np.iinfo(dtype)
    return int(about.min) <= value <= int(about.max)


def _listed(values: Iterable[int]) -> str:
    return ", ".join(str(value) for value in sorted(values))


def find_layout(columns: Sequence[Column], given: GivenLayout, hints: Hints) -> Layout:
    """Return the layout of a file's columns. Raises :class:`AmiwarpError` in doubt, with the option that decides."""
    given.check()
    if columns and not any(column.values.size for column in columns):
        raise AmiwarpError("holds no events; give another recording")
    if _is_openmv(columns) and given.columns is None and not hints.is_text:
        return _openmv_layout()
    roles, assumptions = _find_roles(columns, given, hints)
    chosen = {role: columns[at] for role, at in roles.items()}
    for role, column in chosen.items():
        if column.values.dtype.kind not in "iufb" or column.values.ndim != 1:
            raise AmiwarpError(
                f"column {_shown(columns, roles[role])} for {role} is {column.values.dtype}; give numbers"
            )
    unit, why = _find_unit(chosen["t"], given, hints)
    if why is not None:
        assumptions.append(Assumption("time unit", unit, why, "--time-unit"))
    coding, said = _find_coding(chosen["p"].values, given)
    assumptions += said
    compensated = hints.compensated and all(chosen[role].values.dtype.kind == "f" for role in "xy")
    scale = given.scale_xy or 1
    if given.scale_xy is None and not compensated:
        _check_scale(chosen["x"].values, chosen["y"].values)
    return Layout(
        columns=roles,
        unit=unit,
        coding=coding,
        scale=scale,
        compensated=compensated,
        assumptions=tuple(assumptions),
        unit_is_assumed=why is not None and unit == "us",
        is_promised=given == GivenLayout() and not assumptions and bool(hints.unit or hints.fractions),
        names={role: _shown(columns, at) for role, at in roles.items()},
    )


def _shown(columns: Sequence[Column], at: int) -> str:
    """Return the name of a column, or else its number from 1 on."""
    return columns[at].name or f"column {at + 1}"


# Which column is which.

KNOWN_ORDERS: tuple[tuple[str, ...], ...] = (("t", "x", "y", "p"), ("x", "y", "t", "p"), ("x", "y", "p", "t"))
"""Orders of columns without names that other programs write."""


def _find_roles(columns: Sequence[Column], given: GivenLayout, hints: Hints) -> tuple[dict[str, int], list[Assumption]]:
    """Return the index of the column of each role, and what was assumed."""
    if given.columns is not None:
        return _given_columns(columns, given.columns), []
    if any(column.name for column in columns):
        roles = _named_columns(columns)
        guessed = [
            f"{role} = {columns[at].name}" for role, at in roles.items() if role_of(columns[at].name or "")[0] is None
        ]
        why = "no column has the usual name"
        return roles, [Assumption("columns", ", ".join(guessed), why, "--columns")] if guessed else []
    if len(columns) != len(ROLES):
        raise AmiwarpError(
            f"has {len(columns)} columns without names; say which are which with --columns, such as t,x,y,p"
            + (" (- for a column without use)" if len(columns) > len(ROLES) else "; amiwarp needs t, x, y and p")
        )
    order = _order_by_values([column.values for column in columns], hints)
    roles = {role: order.index(role) for role in ROLES}
    if order == hints.order:
        return roles, []
    why = "the columns have no names, and their values fit this order best"
    return roles, [Assumption("columns", " ".join(order), why, "--columns")]


def _given_columns(columns: Sequence[Column], text: str) -> dict[str, int]:
    """Return the columns that the option ``--columns`` gives."""
    names = [column.name for column in columns]
    roles = {}
    given = given_roles(text)
    for role in ROLES:
        wanted = given[role]
        same = [at for at, name in enumerate(names) if name == wanted]
        if not same:
            same = [at for at, name in enumerate(names) if name and name.rpartition("/")[2] == wanted]
        if not same and wanted.isdecimal() and 1 <= int(wanted) <= len(columns):
            same = [int(wanted) - 1]
        if len(same) != 1:
            known = ", ".join(name for name in names if name)[:300] or f"the numbers 1 to {len(columns)}"
            raise AmiwarpError(f"has no column {wanted!r}, which --columns gives for {role}; it has {known}")
        roles[role] = same[0]
    return roles


def _named_columns(columns: Sequence[Column]) -> dict[str, int]:
    """Return the columns with the names of the roles."""
    names = [column.name or "" for column in columns]
    found = roles_of(names)
    listed = ", ".join(name for name in names if name)[:300]
    for role, places in found.items():
        if len(places) > 1:
            several = " and ".join(names[place] for place in places)
            units = {unit_in(names[place]) for place in places}
            parts = "; if they are parts of one time, join them in one column first" if len(units) > 1 else ""
            raise AmiwarpError(
                f"columns {several} can {'both' if len(places) == 2 else 'all'} be {role}; choose with --columns, such "
                f"as {example_of_columns(names)}{parts}"
            )
    missing = [role for role, at in found.items() if not at]
    if missing:
        raise AmiwarpError(
            f"no column is named as {', '.join(missing)}; the columns are {listed}; choose with --columns, such as "
            f"{example_of_columns(names)}"
        )
    return {role: at[0] for role, at in found.items()}


@dataclass(frozen=True, slots=True)
class _Facts:
    """What the values of a column show."""

    fractions: bool
    """Whether some are no whole numbers."""
    low: float
    high: float
    """Smallest and largest value."""
    rising: bool
    """Whether at most 1 % of the values are smaller than the one before."""
    polarity: bool
    """Whether the values can be polarities: few whole numbers."""
    pixels: bool
    """Whether the values can be coordinates."""

    @classmethod
    def of(cls, values: NDArray[Any]) -> _Facts:
        """Return what values show; values that are not finite are left out."""
        known = values
        if values.dtype.kind == "f":
            wide = values.astype(np.float64)  # float16 holds no larger coordinates
            known = wide[np.abs(wide) < 2.0**63]  # without NaN, too
        if not known.size:
            return cls(True, 0.0, 0.0, False, False, True)
        fractions = known.dtype.kind == "f" and bool((known != np.floor(known)).any())
        low, high = float(known.min()), float(known.max())
        falls = int(np.count_nonzero(known[1:] < known[:-1]))
        few = not fractions and 1 <= len(_common_values(known)) <= 3
        outside = int(np.count_nonzero((known < 0) | (known >= LARGEST_SIZE)))
        return cls(fractions, low, high, _is_rare(falls, known.size), few, fractions or _is_rare(outside, known.size))


def _is_rare(count: int, total: int) -> bool:
    """Return whether at most 1 % of the values have a fault, so that their reader names or repairs it."""
    return count * 100 <= total


def _common_values(values: NDArray[Any]) -> list[Any]:
    """Return the different values, without those that at most 1 % of all have."""
    found, counts = np.unique(values, return_counts=True)
    return [found[at].item() for at in np.flatnonzero(counts * 100 > len(values))]


def _order_by_values(values: Sequence[NDArray[Any]], hints: Hints) -> tuple[str, ...]:
    """Return the order of four columns without names; x is taken to come before y."""
    facts = [_Facts.of(each) for each in values]
    if hints.order is not None and _fits_promise(facts, hints.order):
        return hints.order
    fitting = []
    for order in itertools.permutations(ROLES):
        by_role = {role: facts[at] for at, role in enumerate(order)}
        if order.index("x") < order.index("y") and _fits_order(by_role):
            fitting.append(order)
    times = {order.index("t") for order in fitting}
    if len(times) > 1:  # several columns rise: the time has the widest range by far, or alone has fractions
        best = max(times, key=lambda at: (facts[at].fractions, facts[at].high - facts[at].low))
        if all(_is_clearer(facts[best], facts[at]) for at in times - {best}):
            fitting = [order for order in fitting if order.index("t") == best]
    usual = [order for order in fitting if order in KNOWN_ORDERS]
    if len(usual) == 1:
        fitting = usual
    if len(fitting) == 1:
        return fitting[0]
    orders = " or ".join(" ".join(order) for order in fitting[:3])
    raise AmiwarpError(
        f"has four columns without names, in which the order of t, x, y and p is in doubt ({orders or 'none fits'}); "
        "give it with --columns, such as t,x,y,p"
    )


def _fits_promise(facts: Sequence[_Facts], order: tuple[str, ...]) -> bool:
    """Return whether columns can have the order that the format promises, even if values are damaged."""
    by_role = {role: facts[at] for at, role in enumerate(order)}
    t, x, y, p = (by_role[role] for role in ROLES)
    is_time = t.rising or (t.fractions and not x.fractions and not y.fractions)
    # Where only the last column can be the polarity, wrong coordinates do not make it another order.
    are_places = (x.pixels and y.pixels) or not (x.polarity or y.polarity)
    return is_time and p.polarity and are_places


def _fits_order(by_role: Mapping[str, _Facts]) -> bool:
    """Return whether columns can have these roles."""
    t, x, y, p = (by_role[role] for role in ROLES)
    if not (p.polarity and x.pixels and y.pixels) or x.fractions != y.fractions:
        return False
    beyond = t.high >= LARGEST_SIZE or (t.fractions and not x.fractions)
    return t.rising or beyond


def _is_clearer(best: _Facts, other: _Facts) -> bool:
    """Return whether one column is more clearly the time than another."""
    if best.fractions != other.fractions:
        return best.fractions
    return best.high - best.low > 16 * (other.high - other.low)


# Unit of time.

LONGEST_S = 3600
"""Longest recording whose unit is inferred from whole numbers [s]."""
MOST_PER_US = 1000
"""Largest rate of events that is plausible [1/us]."""
EPOCH_NS, EPOCH_US = (10**17, 4 * 10**18), (10**14, 4 * 10**15)
"""Ranges of times since 1970, from 1973 to 2096 [ns, us]."""
EPOCH_MS = 10**12, 4 * 10**12
"""Range of times since 1970, from 2001 to 2096 [ms]. As microseconds they are weeks after the start of a camera."""
EPOCH_S = 10**9, 4 * 10**9
"""Range of times since 1970, from 2001 to 2096 [s]. As microseconds they are half an hour after the start."""
MOST_PER_STEP = 20
"""Number of events per step of time from which on times in :data:`EPOCH_S` may be whole seconds."""


def _find_unit(column: Column, given: GivenLayout, hints: Hints) -> tuple[str, str | None]:
    """Return the unit of time, and why it was assumed; None if the file states it."""
    if given.time_unit is not None:
        return given.time_unit, None
    named = unit_in(column.name) if column.name else None
    stated = column.unit or named
    if stated is not None:
        return stated, None
    if hints.unit is not None:
        return _promised_unit(column.values, hints)
    t = column.values
    known = t[np.isfinite(t) & (np.abs(t) < TIME_LIMIT)] if t.dtype.kind == "f" else t
    if not known.size:
        return hints.fractions or "us", None
    if known.dtype.kind == "f" and (known != np.floor(known)).any():
        return _unit_of_fractions(known, hints)
    return _unit_of_whole(known)


def _promised_unit(t: NDArray[Any], hints: Hints) -> tuple[str, str | None]:
    """Return the unit of times that a format promises, and why it is another one; None if it is the promised one.

    Raises :class:`AmiwarpError` if whole numbers can be no microseconds.
    """
    assert hints.unit is not None
    if hints.unit != "us" or t.dtype.kind not in "iu" or not t.size:
        return hints.unit, None
    if _is_within(t, EPOCH_NS):
        return "ns", "times are whole numbers, as those in nanoseconds since 1970, but this layout has us"
    if not hints.is_own:
        _check_whole(t)
    return hints.unit, None


def are_microseconds(t: NDArray[Any]) -> bool:
    """Return whether times that a documented layout promises in microseconds can be such."""
    try:
        return _promised_unit(t, Hints(unit="us")) == ("us", None)
    except AmiwarpError:
        return False


def _is_within(t: NDArray[Any], limits: tuple[int, int]) -> bool:
    """Return whether all times lie within limits."""
    return limits[0] <= int(t.min()) and int(t.max()) <= limits[1]


def _check_whole(t: NDArray[Any]) -> None:
    """Raise :class:`AmiwarpError` if times that are whole numbers are likely no microseconds."""
    low, high = int(t.min()), int(t.max())
    if _is_within(t, EPOCH_MS):
        raise AmiwarpError(
            f"the unit of time is in doubt: times from {low} may be milliseconds since 1970, or microseconds; give it "
            "with --time-unit ms or us"
        )
    if _is_within(t, EPOCH_S) and t.size > MOST_PER_STEP * max(high - low, 1):
        raise AmiwarpError(
            f"the unit of time is in doubt: times from {low} may be seconds since 1970, or microseconds; give it with "
            "--time-unit s or us"
        )
    if t.size > MOST_PER_US * max(high - low, 1) + 1000:
        raise AmiwarpError(_whole_doubt(t))


def _whole_doubt(t: NDArray[Any]) -> str:
    """Return the message for times that are whole numbers in an unknown unit."""
    return (
        f"the unit of time is in doubt: times are whole numbers, and the first {t.size:,} events span "
        f"{int(t.max()) - int(t.min()):,}; give it with --time-unit s, ms, us or ns"
    )


def _unit_of_fractions(t: NDArray[Any], hints: Hints) -> tuple[str, str | None]:
    """Return the unit of times with fractions, and why it was assumed; None if the format promises it."""
    if hints.fractions is not None:
        return hints.fractions, None
    span = float(t.max() - t.min())
    if span > 10.0 and t.size / span < 1000.0:
        raise AmiwarpError(
            f"the unit of time is in doubt: times have fractions, and the first {t.size:,} events span {span:.6g}; "
            "give it with --time-unit s, ms, us or ns"
        )
    return "s", f"times have fractions, and the first {t.size:,} events span {span:.3g}"


def _unit_of_whole(t: NDArray[Any]) -> tuple[str, str]:
    """Return the unit of times that are whole numbers, and why."""
    for unit, limits in (("ns", EPOCH_NS), ("us", EPOCH_US)):
        if _is_within(t, limits):
            return unit, "times are whole numbers, as those since 1970"
    _check_whole(t)
    span = int(t.max()) - int(t.min())
    if span > LONGEST_S * 10**6:
        raise AmiwarpError(_whole_doubt(t))
    return "us", f"times are whole numbers, and the first {t.size:,} events span {span * 1e-6:.3g} s then"


def check_duration(layout: Layout, duration_us: int) -> None:
    """Raise :class:`AmiwarpError` if a recording whose unit was inferred is longer than :data:`LONGEST_S`."""
    if layout.unit_is_assumed and duration_us > LONGEST_S * 10**6:
        raise AmiwarpError(
            f"the unit of time is in doubt: times are whole numbers; in us, the recording would last "
            f"{duration_us * 1e-6:,.0f} s; give it with --time-unit s, ms, us or ns"
        )


# Coding of polarity, and scale of coordinates.


def is_plain_polarity(p: NDArray[Any]) -> bool:
    """Return whether values of the polarity are 1 for ON, 0 or -1 for OFF."""
    if p.dtype == np.bool_ or (p.dtype.kind == "u" and int(p.max(initial=0)) <= 1):
        return True
    return set(np.unique(p).tolist()) <= set(SIGNED)


def _find_coding(p: NDArray[Any], given: GivenLayout) -> tuple[Coding, list[Assumption]]:
    """Return the meaning of the values of the polarity, and what was assumed."""
    if given.polarity is not None:
        return given_polarity(given.polarity), []
    if p.dtype == np.bool_:
        return ZERO_OR_ONE, []
    if not p.size:
        return SIGNED, []
    values: list[Any] = [int(value) if float(value).is_integer() else value for value in _common_values(p)]
    if len(values) > 8 or not values:
        raise AmiwarpError(
            f"the polarity has many different values, {p.min()} to {p.max()}; choose its column with --columns, or "
            "give --polarity, such as 1=on,2=off"
        )
    found = set(values)
    if len(found) == 1 and found <= {-1, 0, 1}:
        (value,) = values
        meaning = "ON" if value == 1 else "OFF"
        why = f"the first {p.size:,} events all have the polarity {value}"
        return SIGNED, [Assumption("polarity", f"{value} is {meaning}", why, "--polarity")]
    if found in ({0, 1}, {-1, 1}):
        return SIGNED, []
    large = found - {0, 1}
    if 1 in found and len(large) == 1 and large <= set(UNSIGNED_MINUS_ONE):
        (value,) = large
        why = f"it is -1 in an unsigned integer, and the values are {_listed(found)}"
        return {**ZERO_OR_ONE, value: False}, [Assumption("polarity", f"{value} is OFF", why, "--polarity")]
    raise AmiwarpError(
        f"the polarity has the values {', '.join(map(str, values))}, of which ON and OFF are not known; say so with "
        "--polarity, such as 1=on,2=off"
    )


LARGEST_SENSOR = 2048
"""Sides of sensors are at most this [px]."""


def _check_scale(x: NDArray[Any], y: NDArray[Any]) -> None:
    """Raise :class:`AmiwarpError` if coordinates are multiples of a pixel's fraction."""
    if x.dtype.kind not in "iu" or y.dtype.kind not in "iu" or not x.size:
        return
    largest = max(int(x.max()), int(y.max()))
    common = int(np.gcd(np.gcd.reduce(x), np.gcd.reduce(y)))
    if largest >= LARGEST_SENSOR and common > 1:
        raise AmiwarpError(
            f"x and y reach {largest} and are multiples of {common}, as fixed-point numbers are; divide them with "
            f"--scale-xy {common}, or keep them with --scale-xy 1"
        )


# OpenMV's arrays of the GenX320.


def _is_openmv(columns: Sequence[Column]) -> bool:
    """Return whether columns are those of OpenMV: type, s, ms, us, x, y."""
    if len(columns) != 6 or any(column.name for column in columns):
        return False
    if any(column.values.dtype.kind not in "iuf" or not column.values.size for column in columns):
        return False
    limits = (16, 2**32, 1000, 1000, 320, 320)
    return all(
        column.values.min() >= 0 and column.values.max() < limit and (column.values == np.floor(column.values)).all()
        for column, limit in zip(columns, limits, strict=True)
    )


def _openmv_layout() -> Layout:
    """Return the layout of OpenMV's arrays."""
    names = ("type", "s", "ms", "us", "x", "y")
    why = "six columns of whole numbers, as OpenMV writes them for the GenX320"
    return Layout(
        columns={name: at for at, name in enumerate(names)},
        unit="us",
        coding=ZERO_OR_ONE,
        assumptions=(Assumption("columns", " ".join(names), why, "--columns"),),
        openmv=True,
        names={name: f"column {at + 1}" for at, name in enumerate(names)},
    )
