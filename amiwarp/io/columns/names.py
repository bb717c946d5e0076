"""Names of columns in files of plain columns: which of them mean t, x, y and p, and the units of time in them.

Names that nearly always mean the same decide first, then those that only stand for a role where no other does.
"""

import re
from collections.abc import Collection, Iterable, Sequence

from amiwarp.errors import AmiwarpError

ROLES = ("t", "x", "y", "p")
"""Columns of an event: time, column and row of the pixel, polarity."""

NAMES = {
    "t": (
        "t",
        "ts",
        "time",
        "times",
        "timestamp",
        "timestamps",
        "time_stamp",
        "time_stamps",
        "tstamp",
    ),
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
    name = text.strip().lower()
    return next((unit for unit, names in UNIT_NAMES.items() if name in names), None)


def role_of(name: str) -> tuple[str | None, str | None]:
    """Return the role of a column of this name, and the unit of time in the name; None for what is unknown."""
    plain = re.split(r"[/.]", name.strip().strip("\"'").lower())[-1].strip()
    plain = re.sub(r"^(?:events?|evts?|ev|dvs)[_\s-]+", "", plain)
    for role, names in NAMES.items():
        if plain in names:
            return role, None
    # A name and a unit: in brackets, behind a separator, or, of a time, immediately behind it.
    match = re.fullmatch(
        r"(.+?)[\s_-]*[(\[{]([^)\]}]*)[)\]}]|(.+?)[_\s-]+(\S+)|(timestamps?|time)(\S+)", plain
    )
    if match is None:
        return None, None
    stem = match[1] or match[3] or match[5]
    suffix = match[2] or match[4] or match[6] or ""
    own_role = next((role for role, names in NAMES.items() if stem in names), None)
    unit = unit_of(suffix)
    if own_role == "t" and unit is not None:
        return own_role, unit
    if own_role in ("x", "y") and suffix in ("px", "pixel", "pixels"):
        return own_role, None
    return None, None


RARE_NAMES = {
    "x": (
        "u",
        "colindex",
        "colidx",
        "columnindex",
        "xaddr",
        "xaddress",
        "addrx",
        "addressx",
        "xpos",
        "xposition",
        "posx",
        "positionx",
        "xcoord",
        "xcoords",
        "xcoordinate",
        "xcoordinates",
        "coordx",
        "coordinatex",
        "xidx",
        "xindex",
        "xpx",
        "xpixel",
        "pixelx",
        "pxx",
        "xloc",
        "locx",
    ),
    "y": (
        "v",
        "rowindex",
        "rowidx",
        "yaddr",
        "yaddress",
        "addry",
        "addressy",
        "ypos",
        "yposition",
        "posy",
        "positiony",
        "ycoord",
        "ycoords",
        "ycoordinate",
        "ycoordinates",
        "coordy",
        "coordinatey",
        "yidx",
        "yindex",
        "ypx",
        "ypixel",
        "pixely",
        "pxy",
        "yloc",
        "locy",
    ),
    "p": (
        "onoff",
        "offon",
        "sign",
        "signs",
        "sgn",
        "polar",
        "positive",
        "ispositive",
        "isonevent",
        "polaritybool",
        "polbool",
        "polaritybinary",
        "polaritysign",
        "polaritysigned",
        "polarityvalue",
        "polarity01",
        "pol01",
        "polarityonoff",
        "onoffpolarity",
    ),
}
"""Names that stand for a role where no column has one of :data:`NAMES`: in lower case, of letters and digits only."""

_UNIT_PATTERN = "|".join(
    sorted((name for names in UNIT_NAMES.values() for name in names), key=len, reverse=True)
)
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
    if role is None:
        _, unit = _rare_role_of(name)
    return unit


NO_TIME_UNITS = ("", "-", "1", "px", "pixel", "pixels", "bool")
"""Units of columns that are no times, in a line of units."""


def units_in(names: Sequence[str], row: Sequence[str], where: str) -> tuple[str | None, ...]:
    """Return the units of time in a line of units below the names of columns; none if the line is no such line.

    ``where`` names the line for messages. Raises :class:`AmiwarpError` if a name states another unit.
    """
    words = [word.strip().strip("[](){}").strip().lower() for word in row]
    units = [unit_of(word) for word in words]
    known = all(
        unit is not None or word in NO_TIME_UNITS for word, unit in zip(words, units, strict=True)
    )
    if not known or not any(units):
        return ()
    for name, unit in zip(names, units, strict=False):
        stated = unit_in(name)
        if unit is not None and stated not in (None, unit):
            raise AmiwarpError(
                f"{where} gives the unit {unit} for column {name}; change the name or the line"
            )
    return tuple(units)


def roles_of(names: Sequence[str]) -> dict[str, list[int]]:
    """Return for each role the indices of the columns that can have it by their names.

    Columns with :data:`RARE_NAMES` count only for a role that no other column has, and for x and y only together: next
    to x, v is a speed. But a time in whole seconds may have its fractions in another column.
    """
    places: dict[str, list[int]] = {role: [] for role in ROLES}
    rarely: dict[str, list[int]] = {role: [] for role in ROLES}
    units: list[str | None] = []
    for column, name in enumerate(names):
        role, unit = role_of(name)
        if role is not None:
            places[role].append(column)
        else:
            role, unit = _rare_role_of(name)
            if role is not None:
                rarely[role].append(column)
        units.append(unit)

    if [units[column] for column in places["t"]] == ["s"]:
        places["t"] += [column for column in rarely["t"] if units[column] not in (None, "s")]
    places["t"] = places["t"] or rarely["t"]
    places["p"] = places["p"] or rarely["p"]
    if not places["x"] and not places["y"]:
        places["x"] = rarely["x"]
        places["y"] = rarely["y"]
    return places


def names_roles(names: Iterable[str]) -> bool:
    """Return whether a file's columns of these names hold events."""
    return all(roles_of(list(names)).values())


def example_of_columns(names: Iterable[str]) -> str:
    """Return an example of the option ``--columns`` with names of this file, and NAME for what none is named as.

    Of names with groups, the names of the group with the most roles are taken.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(name.rpartition("/")[0], []).append(name)
    best: dict[str, str] = {}
    for members in groups.values():
        found = {role: members[places[0]] for role, places in roles_of(members).items() if places}
        if len(found) > len(best):
            best = found
    return ",".join(f"{role}={best.get(role, 'NAME')}" for role in ROLES)


def is_wanted(name: str, wanted: Collection[str]) -> bool:
    """Return whether a column of this name, with or without its groups, is among the wanted names."""
    return name in wanted or name.rpartition("/")[2] in wanted
