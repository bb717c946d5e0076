"""Every enum of the public API may be given as a member or its exact name; all else is refused with the choices."""

import enum
import importlib
import inspect
import os
import pkgutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amiwarp
from amiwarp import (
    AmiwarpError,
    Camera,
    CircleModel,
    Events,
    ExactModel,
    Fill,
    FlatSide,
    Format,
    Layers,
    MemoryEvents,
    PhotometricSettings,
    Picture,
    Plate,
    Policy,
    Prism,
    RadialCircleModel,
    Reconstruction,
    Recording,
    Settings,
    Sharpness,
    UnsizedPrism,
    Vote,
    apex_from_deflection,
    deflection_from_apex,
    iwe,
    open_recording,
    sharpness,
)
from amiwarp.calib import GLOBAL_ALGORITHMS, LOCAL_ALGORITHMS
from amiwarp.calib.presets import simplified
from amiwarp.calib.settings import STAGES
from amiwarp.choices import Axis, Colour, Tone, View
from amiwarp.imaging import CanvasShape, SharpnessMeter
from amiwarp.imaging.export import IweFiles, to_picture
from amiwarp.live import PacketQueue
from amiwarp.optics import MODELS, build_model
from amiwarp.reconstruction import save_picture
from amiwarp.reconstruction.picture_files import tones
from amiwarp.viewer import Look

CAMERA = Camera.from_fov(8, 6, 1.0)
EVENTS = Events.from_arrays([1, 2, 1, 2], [1, 2, 1, 2], [0, 10, 20, 30], [0, 1, 0, 1])
SOURCE = MemoryEvents(EVENTS, 8, 6)
IMAGE = np.arange(48, dtype=np.float32).reshape(6, 8)


def glass(name: Any) -> Prism | Plate:
    """Return the glass of a model, a prism for what is no name of a model."""
    return Plate(0.01, 0.7) if isinstance(name, str) and name == "plate" else Prism(0.02)


def picture() -> Picture:
    return Picture(IMAGE, np.ones((6, 8), np.bool_), 0, 10, 4, 0.0, 1.0, 0.1, 0, 0.0, IMAGE)


def reconstruction(fill: Any) -> Fill:
    encoder = amiwarp.Encoder.constant_speed(720.0, 0, 100)
    return Reconstruction(
        Recording(SOURCE, CAMERA, encoder), model=ExactModel(CAMERA, Prism(0.02)), fill=fill
    ).fill


def layers_of(layers: Any) -> None:
    with IweFiles([], SOURCE, window_us=None, layers=layers, device="cpu") as files:
        files.add(EVENTS)


def settled(**given: Any) -> Settings:
    made = Settings(**given)
    made.check()
    return made


TAKES: list[tuple[str, type[enum.StrEnum], Callable[[Any], Any]]] = [
    ("Prism", FlatSide, lambda side: Prism(0.02, 1.5, side).flat_side),
    ("UnsizedPrism", FlatSide, lambda side: UnsizedPrism(1.5, side).flat_side),
    ("CircleModel", FlatSide, lambda side: CircleModel(CAMERA, 0.02, 0.0, side).flat_side),
    (
        "RadialCircleModel",
        FlatSide,
        lambda side: RadialCircleModel(CAMERA, 0.02, 0.0, 1.5, side).flat_side,
    ),
    ("deflection_from_apex", FlatSide, lambda side: deflection_from_apex(0.1, 1.5, side)),
    ("apex_from_deflection", FlatSide, lambda side: apex_from_deflection(0.1, 1.5, side)),
    ("sharpness", Sharpness, lambda kind: sharpness(IMAGE, kind)),
    (
        "SharpnessMeter",
        Sharpness,
        lambda kind: SharpnessMeter(CanvasShape(8, 6), kind, smoothing=0, device="cpu").kind,
    ),
    ("Settings.sharpness", Sharpness, lambda kind: settled(sharpness=kind).sharpness),
    ("CanvasShape", Vote, lambda vote: CanvasShape(8, 6, vote=vote).vote),
    ("iwe", Vote, lambda vote: float(iwe(EVENTS, 8, 6, vote=vote).sum())),
    ("Reconstruction", Fill, reconstruction),
    ("tones", Tone, lambda tone: float(tones(picture(), tone).sum())),
    (
        "save_picture",
        Tone,
        lambda tone: save_picture(picture(), Path(f"out{len(os.listdir())}.png"), tone=tone),
    ),
    ("IweFiles", Layers, layers_of),
    ("to_picture", Layers, lambda layers: float(to_picture(np.stack([IMAGE] * 2), layers).sum())),
    ("PacketQueue", Policy, lambda policy: PacketQueue(10, policy).policy),
    ("Look.colour", Colour, lambda colour: Look(colour=colour).colour),
    ("Look.axis", Axis, lambda axis: Look(axis=axis).axis),
]
"""Uses of each enum. The result must be the same for a member and for its name."""

WRONG = [
    "",
    "Scene",
    "SCENE",
    "nothing",
    " scene",
    None,
    0,
    True,
    1.5,
    float("nan"),
    ["scene"],
    b"scene",
    np.arange(2),
]
OTHERS: list[tuple[str, tuple[str, ...], Callable[[Any], Any]]] = [
    ("open_recording", tuple(Format), lambda name: open_recording("nowhere", format=name)),
    ("Settings.model", ("auto", *MODELS), lambda name: settled(model=name)),
    ("build_model", tuple(MODELS), lambda name: build_model(name, CAMERA, glass(name), VALUES)),
    ("Settings.global_algorithm", GLOBAL_ALGORITHMS, lambda name: settled(global_algorithm=name)),
    ("Settings.local_algorithm", LOCAL_ALGORITHMS, lambda name: settled(local_algorithm=name)),
    (
        "PhotometricSettings.algorithm",
        LOCAL_ALGORITHMS,
        lambda name: settled(photometric=PhotometricSettings(algorithm=name)),
    ),
]
VALUES = {"amplitude": 0.01, "apex": 0.02, "deflection": 0.01, "inverse_depth": 2.0, "phase": 0.0}
MEANS_SOMETHING_ELSE = {("Settings.global_algorithm", None), ("open_recording", None)}
"""Here None has a meaning, which the docstring states."""


@pytest.mark.parametrize(("name", "kind", "use"), TAKES, ids=[name for name, _, _ in TAKES])
def test_enum_and_exact_name_do_the_same(
    name: str,
    kind: type[enum.StrEnum],
    use: Callable[[Any], Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    for member in kind:
        if (name, member) == ("to_picture", Layers.MERGED) or (name, member) == (
            "to_picture",
            Layers.SIGNED,
        ):
            continue  # these take an image without polarities; the next two entries test them
        by_member = use(member)
        assert use(member.value) == by_member
        if isinstance(by_member, enum.Enum):
            assert by_member is use(member.value) is member


@pytest.mark.parametrize("layers", [Layers.MERGED, Layers.SIGNED])
def test_pictures_of_one_layer(layers: Layers) -> None:
    np.testing.assert_array_equal(to_picture(IMAGE, layers), to_picture(IMAGE, layers.value))  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", WRONG, ids=repr)
@pytest.mark.parametrize(("name", "kind", "use"), TAKES, ids=[name for name, _, _ in TAKES])
def test_anything_else_is_refused_with_the_choices(
    name: str, kind: type[enum.StrEnum], use: Callable[[Any], Any], wrong: Any
) -> None:
    with pytest.raises(AmiwarpError) as caught:
        use(wrong)
    assert f"choose among {', '.join(kind)}" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "known", "use"), OTHERS, ids=[name for name, _, _ in OTHERS])
def test_names_that_are_no_enums(
    name: str, known: tuple[str, ...], use: Callable[[Any], Any]
) -> None:
    for wrong in WRONG:
        if (name, wrong if isinstance(wrong, str | None) else "") in MEANS_SOMETHING_ELSE:
            continue
        with pytest.raises(AmiwarpError) as caught:
            use(wrong)
        assert all(choice in str(caught.value) for choice in known)
    if name != "open_recording":
        for choice in known:
            use(choice)


def test_stages_are_one_of_two_tuples() -> None:
    for good, expected in (
        (STAGES, STAGES),
        ([*STAGES], STAGES),
        (STAGES[:1], STAGES[:1]),
        ("sharpness", STAGES[:1]),
    ):
        assert settled(stages=good).stages == expected
    for wrong in (
        "photometric",
        ("photometric",),
        ("sharpness", "sharpness"),
        None,
        3,
        (np.arange(2),),
        [],
        "",
    ):
        with pytest.raises(
            AmiwarpError, match=r"expected 'sharpness' or \('sharpness', 'photometric'\)"
        ):
            settled(stages=wrong)


PUBLIC_ENUMS = [
    kind
    for name in amiwarp.PUBLIC_NAMES
    if isinstance(kind := getattr(amiwarp, name), enum.EnumType)
]


@pytest.mark.parametrize("kind", PUBLIC_ENUMS, ids=lambda kind: kind.__name__)
def test_an_enum_called_with_another_value_names_its_values(kind: type[enum.StrEnum]) -> None:
    with pytest.raises(
        AmiwarpError, match=f"{kind.__name__} is 'nothing'; choose among .*{[*kind][-1].value}"
    ):
        kind("nothing")


def test_simplified_names_its_models() -> None:
    """``simplified`` checks the model's name before it uses the calibration."""
    for wrong in WRONG:
        with pytest.raises(AmiwarpError, match="circle, exact, radial, ellipse"):
            simplified(None, wrong)  # type: ignore[arg-type]


def test_views_are_taken_by_name(tmp_path: Path) -> None:
    from amiwarp.viewer.look import CAMERA_DIRECTIONS

    # Names and members select the same camera position
    assert set(CAMERA_DIRECTIONS) == {view.value for view in View}


def test_the_wrong_side_can_no_longer_be_taken_by_its_name() -> None:
    """A string once selected the other side without an error: 18 px at 60 deg and an apex of 1 deg."""
    by_name, by_member = Prism(0.1, flat_side="scene"), Prism(0.1, flat_side=FlatSide.SCENE)  # type: ignore[arg-type]
    assert by_name == by_member
    assert (
        by_name.deflection
        == by_member.deflection
        != replace(by_name, flat_side=FlatSide.CAMERA).deflection
    )
    xy, theta = np.array([[3.0, 2.0], [0.0, 5.0]]), np.array([0.3, 2.0])
    one, other = (
        ExactModel(CAMERA, prism).compensate_points(xy, theta) for prism in (by_name, by_member)
    )
    np.testing.assert_array_equal(one, other)


def test_every_enum_of_the_package_is_of_text() -> None:
    """As a string, a member equals its name, sorts and prints like it, and is written to JSON as it."""
    plain = []
    for info in pkgutil.walk_packages(amiwarp.__path__, "amiwarp."):
        if info.name == "amiwarp.__main__":
            continue
        module = importlib.import_module(info.name)
        plain += [
            f"{info.name}.{name}"
            for name, value in inspect.getmembers(module, inspect.isclass)
            if issubclass(value, enum.Enum)
            and value.__module__ == info.name
            and not issubclass(value, enum.StrEnum)
        ]
    assert plain == []
