"""Values at the doors: fields of files, and arguments of functions, by their annotations."""

from __future__ import annotations

import enum
import inspect
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from amiwarp import AmiwarpError, Camera, Events
from amiwarp.schema.annotations import annotated_type, leaves
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import LARGEST_INTEGER, check_format, value_of, with_fields
from amiwarp.validation import real

if TYPE_CHECKING:
    from torch import Tensor

    from amiwarp import Recording


class Side(enum.StrEnum):
    LEFT = "left"
    RIGHT = "right"


class Pair(TypedDict):
    first: int
    second: str


@dataclass(frozen=True)
class Inner:
    apex: Annotated[float, partial(real, low=0.0, high=0.5, hint=" rad")]
    points: tuple[Mapping[str, float], ...] = ()
    span: tuple[float, int] | None = None


@dataclass(frozen=True)
class Outer:
    name: str
    inner: tuple[Inner, ...]
    side: Side = Side.LEFT
    kind: Literal["a", "b"] = "a"
    flags: list[bool] = field(default_factory=list)
    pair: Pair | None = None
    count: int = 3


WHOLE = {
    "name": "x",
    "inner": [
        {"apex": 0.1},
        {"apex": 1 / 3, "points": [{"a": 1, "b": 2.5}], "span": [1, 2]},
    ],
    "side": "right",
    "kind": "b",
    "flags": [True, False],
    "pair": {"first": 1, "second": "two"},
    "count": LARGEST_INTEGER,
}


def test_a_record_has_the_types_of_its_fields() -> None:
    found = value_of(Outer, WHOLE, "")
    points = ({"a": 1.0, "b": 2.5},)
    assert found == Outer(
        name="x",
        inner=(Inner(0.1), Inner(1 / 3, points, (1.0, 2))),
        side=Side.RIGHT,
        kind="b",
        flags=[True, False],
        pair={"first": 1, "second": "two"},
        count=LARGEST_INTEGER,
    )
    assert isinstance(found.inner[1].points[0]["a"], float)
    assert isinstance(found.inner[1].span[0], float)
    assert found.side is Side.RIGHT
    assert value_of(Outer, {"name": "x", "inner": []}, "") == Outer("x", ())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": 1}, "field top.name is 1; expected text"),
        ({"nam": "x"}, r"field top.nam is unknown; expected name, inner, .*; did you mean name\?"),
        ({"inner": [{"apex": 0.1}, {}]}, r"field top.inner\[1\].apex is missing; add this field"),
        (
            {"inner": [{"apex": 0.6}]},
            r"field top.inner\[0\].apex = 0.6 is not a finite number in 0 .. 0.5 rad",
        ),
        (
            {"inner": [{"apex": 0.1, "points": [{}, {}, {"x\n": None}]}]},
            r"field top.inner\[0\].points\[2\].x\\n = None is not a finite number",
        ),
        (
            {"inner": [{"apex": 0.1, "span": [1.0]}]},
            r"field top.inner\[0\].span has 1 entries; expected 2",
        ),
        (
            {"inner": [{"apex": 0.1, "span": [1.0, 2.0]}]},
            r"field top.inner\[0\].span\[1\] = 2.0 is not a whole number",
        ),
        ({"inner": {}}, r"field top.inner is \{\}; expected a list"),
        ({"side": "top"}, "field top.side is 'top'; choose among left, right"),
        ({"kind": "c"}, "field top.kind is 'c'; choose among a, b"),
        ({"flags": [True, 1]}, r"field top.flags\[1\] is 1; expected true or false"),
        ({"pair": {"first": 1}}, "field top.pair.second is missing"),
        ({"pair": {"first": True, "second": ""}}, "field top.pair.first = True"),
        ({"count": LARGEST_INTEGER + 1}, "field top.count = 4611686018427387905"),
    ],
)
def test_a_message_names_the_field_and_its_value(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(AmiwarpError, match=f"^{message}"):
        value_of(Outer, {**WHOLE, **changes}, "top")


def test_a_field_of_the_whole_file_has_no_prefix() -> None:
    with pytest.raises(AmiwarpError, match=r"^field count = 'many' is not a whole number"):
        value_of(Outer, {**WHOLE, "count": "many"}, "")


def test_a_record_gets_the_fields_that_a_file_gives() -> None:
    record = Inner(0.1, span=(1.0, 2))
    assert with_fields(record, {"apex": 0.5}, "top") == Inner(0.5, span=(1.0, 2))
    assert with_fields(record, {"span": None}, "top", ("span",)) == Inner(0.1)
    with pytest.raises(AmiwarpError, match=r"^field top.apex = 0.6 is not .* 0 .. 0.5 rad"):
        with_fields(record, {"apex": 0.6}, "top")
    with pytest.raises(AmiwarpError, match=r"^field top.apex is unknown; expected span"):
        with_fields(record, {"apex": 0.1}, "top", ("span",))


@dataclass(frozen=True)
class Ordered:
    low: float
    high: float

    def __post_init__(self) -> None:
        if self.high < self.low:
            raise AmiwarpError(f"high = {self.high} is below low")


def test_what_a_class_refuses_names_the_field() -> None:
    with pytest.raises(AmiwarpError, match=r"^field spans\[1\]: high = 1.0 is below low"):
        value_of(list[Ordered], [{"low": 1, "high": 2}, {"low": 2, "high": 1}], "spans")
    with pytest.raises(AmiwarpError, match=r"^high = 1.0 is below low"):
        value_of(Ordered, {"low": 2, "high": 1}, "")
    with pytest.raises(AmiwarpError, match=r"^field span: high = -1.0 is below low"):
        with_fields(Ordered(0.0, 1.0), {"high": -1.0}, "span")


@pytest.mark.parametrize("given", [("other", 1), ("mine", 2)])
def test_the_format_and_version_of_a_file(given: tuple[str, int]) -> None:
    check_format({"format": "mine", "version": 1}, "mine", 1)
    with pytest.raises(
        AmiwarpError, match=f"are '{given[0]}' and {given[1]}; expected 'mine' and 1"
    ):
        check_format({"format": given[0], "version": given[1]}, "mine", 1)


@pytest.mark.parametrize("kind", [complex, int | str, bytes, tuple[bytes, ...]])
def test_a_type_that_json_has_not_is_a_mistake_of_the_program(kind: Any) -> None:
    with pytest.raises((TypeError, ValueError)):
        value_of(kind, [1], "top")


def annotated(
    later: Recording | None,
    library: Tensor,
    numbers: NDArray[np.float64] | None,
    anything: ArrayLike,
    call: Callable[[str, float], None] | None,
    word: Literal["us", "s"],
    names: Sequence[str],
) -> None:
    """Carry annotations, some of which are imported for type checkers only."""


def test_types_of_annotations_are_found_later() -> None:
    import amiwarp

    assert annotated_type(annotated, "later") == amiwarp.Recording | None
    for name in ("anything", "library"):
        assert annotated_type(annotated, name) == Any, name
    found = {name: leaves(annotated_type(annotated, name)) for name in annotated.__annotations__}
    assert found["numbers"] == {np.ndarray, type(None)}
    assert found["call"] == {Callable, type(None)}
    assert found["word"] == {Literal}
    assert found["names"] == {Sequence, str}


def functions_of(value: Any) -> list[Any]:
    """Return the undecorated functions of a public function or class that check their arguments."""
    members = [value]
    if inspect.isclass(value):
        members = [inspect.unwrap(getattr(one, "__func__", one)) for one in vars(value).values()]
    found = [inspect.unwrap(one) for one in members if inspect.isfunction(one)]
    return [one for one in found if one.__module__.startswith("amiwarp.")]


def test_every_annotation_of_the_package_can_be_resolved() -> None:
    import amiwarp

    functions = [
        function
        for name in amiwarp.PUBLIC_NAMES
        for function in functions_of(getattr(amiwarp, name))
    ]
    assert len(functions) > 500
    for function in functions:
        for name in function.__annotations__:
            assert leaves(annotated_type(function, name)), f"{function.__qualname__}: {name}"


@guarded
def checked(
    events: Events | None = None,
    *,
    count: int = 0,
    share: float | None = None,
    names: Sequence[str] | None = (),
    t_start: int | None = None,
    dark: bool = False,
    path: str | Path = "a",
) -> tuple[Any, ...]:
    """Return the arguments as the function gets them."""
    return events, count, share, names, t_start, dark


def test_arguments_come_in_their_plain_types() -> None:
    given = checked(None, count=np.int32(3), share=np.float32(0.5), names="one", t_start=None)
    assert given == (None, 3, 0.5, ("one",), None, False)
    assert [type(value) for value in given[1:3]] == [int, float]
    assert checked(names=["a", "b"])[3] == ("a", "b")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"events": 3}, "checked: events is 3; expected Events or None$"),
        ({"count": 2.0}, "checked: count = 2.0 is not a whole number, but a float; give an int"),
        ({"count": True}, "checked: count = True is not a whole number"),
        ({"share": float("nan")}, "checked: share = nan is not a finite number"),
        ({"names": [1]}, "checked: names is .*; expected tuple or list, each a text"),
        ({"t_start": 0.1}, "checked: t_start = 0.1 .*; times are whole microseconds"),
        ({"path": "a\0b"}, "checked: path is .*; expected a path without null bytes"),
        ({"dark": 1}, "checked: dark is 1; expected True or False"),
    ],
)
def test_arguments_of_another_kind_are_refused(given: dict[str, Any], message: str) -> None:
    # what was accepted before must not make later calls careless
    checked(None, count=1, share=0.5, names=["a"], t_start=3, dark=True, path="b")
    with pytest.raises(AmiwarpError, match=message):
        checked(**given)


@guarded
class Marked:
    """Class whose methods check their arguments."""

    def __init__(self, camera: Camera, share: float) -> None:
        self.camera = camera
        self.share = share

    def scaled(self, factor: float, camera: Camera | None = None) -> float:
        """Return the share times a factor."""
        return self.share * factor

    @classmethod
    def of_share(cls, share: float) -> Marked:
        """Return an object with a usual camera."""
        return cls(Camera.from_fov(4, 3, 1.0), share)


def test_methods_check_their_arguments_by_position_and_by_name() -> None:
    made = Marked.of_share(0.5)
    assert made.scaled(np.float64(2.0), made.camera) == 1.0
    with pytest.raises(AmiwarpError, match=r"^Marked: camera is 3; expected Camera"):
        Marked(3, 0.5)  # type: ignore[arg-type]
    assert Marked(made.camera, "any").share == "any"  # type: ignore[arg-type]  # its own business
    for call in (lambda: made.scaled("2"), lambda: made.scaled(factor="2")):  # type: ignore[arg-type]
        with pytest.raises(AmiwarpError, match=r"^Marked\.scaled: factor = '2' is not a finite"):
            call()
    with pytest.raises(
        AmiwarpError, match=r"^Marked\.scaled: camera is 2.0; expected Camera or None"
    ):
        made.scaled(1.0, 2.0)  # type: ignore[arg-type]
    with pytest.raises(AmiwarpError, match=r"^Marked\.of_share: share = None"):
        Marked.of_share(None)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Chain:
    """Record with a field of its own type."""

    length: int
    next: Chain | None = None


def test_a_record_may_have_a_field_of_its_own_type() -> None:
    found = value_of(Chain, {"length": 1, "next": {"length": 2}}, "chain")
    assert found == Chain(1, Chain(2))
    with pytest.raises(AmiwarpError, match=r"field chain\.next\.length"):
        value_of(Chain, {"length": 1, "next": {"length": "2"}}, "chain")


def test_annotations_are_resolved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search makes thousands of calls with mappings and numbers: only the first one looks at the annotations."""

    @guarded
    def moved(values: Mapping[str, float], shift: float | None, camera: Camera | None) -> float:
        return values["x"] + (shift or 0.0)

    assert moved({"x": 1.0}, 0.5, None) == 1.5

    def refuse(_: object) -> None:
        raise AssertionError("an annotation was resolved again")

    monkeypatch.setattr(typing, "get_origin", refuse)
    monkeypatch.setattr(typing, "get_args", refuse)
    assert moved({"x": 2.0, "y": 3}, 0.25, None) == 2.25
    assert moved({"x": np.float32(2.0)}, np.float64(0.25), None) == 2.25
    for values in ({"x": math.nan}, {"x": "1"}, {1: 1.0}, [1.0]):
        with pytest.raises(AmiwarpError, match=r"moved: values is .*mapping"):
            moved(values, 0.0, None)  # type: ignore[arg-type]
    for shift in (math.inf, "1", True):
        with pytest.raises(AmiwarpError, match="moved: shift"):
            moved({"x": 1.0}, shift, None)  # type: ignore[arg-type]
