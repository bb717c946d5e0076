"""An index or a flat side without an apex: the apex stays unknown in the file, in info and for calibration."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    FlatSide,
    Prism,
    Recording,
    UnsizedPrism,
    calibrate,
    open_recording,
    save_recording,
    simulate,
)
from amiwarp.cli.common import NominalPrismOptions
from amiwarp.io.native.attributes import prism_attributes, read_prism
from amiwarp.viewer import Inspector
from tests.command_line import app

APEX, INDEX = math.radians(1.0), 1.55


@pytest.fixture(scope="module")
def bare(texture: np.ndarray) -> Recording:
    """Events behind a prism of 1 deg. The recording has no prism."""
    camera = Camera.from_fov(120, 90, math.radians(50))
    recording = simulate(texture, camera, Prism(APEX, INDEX), duration_s=0.2, seed=1)
    return replace(recording, prism=None, truth=None)


def run(*words: Any) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.parametrize(
    ("known", "options", "expected"),
    [
        (None, NominalPrismOptions(), None),
        (None, NominalPrismOptions(index=INDEX), UnsizedPrism(INDEX)),
        (
            None,
            NominalPrismOptions(flat_side=FlatSide.CAMERA),
            UnsizedPrism(flat_side=FlatSide.CAMERA),
        ),
        (None, NominalPrismOptions(nominal_apex_deg=1.0), Prism(APEX)),
        (UnsizedPrism(INDEX), NominalPrismOptions(nominal_apex_deg=1.0), Prism(APEX, INDEX)),
        (UnsizedPrism(INDEX), NominalPrismOptions(), UnsizedPrism(INDEX)),
        (Prism(APEX), NominalPrismOptions(index=INDEX), Prism(APEX, INDEX)),
        (
            Prism(APEX, INDEX),
            NominalPrismOptions(nominal_apex_deg=2.0),
            Prism(math.radians(2.0), INDEX),
        ),
    ],
)
def test_options_over_what_is_known(
    known: Any, options: NominalPrismOptions, expected: Any
) -> None:
    assert options.build(known) == expected


def test_convert_info_and_calibrate_with_an_index_alone(bare: Recording, tmp_path: Path) -> None:
    """Formerly an apex of 2 deg that nobody gave was stored, and the true prism of 1 deg was refused."""
    save_recording(tmp_path / "bare.h5", bare)
    converted = tmp_path / "indexed.h5"
    run("convert", tmp_path / "bare.h5", converted, "--index", INDEX)
    with h5py.File(converted) as file:
        assert dict(file["prism"].attrs) == {"index": INDEX, "flat_side": "scene"}
    assert open_recording(converted).prism == UnsizedPrism(INDEX)
    assert "apex unknown, n 1.55, flat face to the scene" in run("info", converted)
    assert json.loads(run("info", converted, "--json"))["prism"] == {
        "apex_deg": None, "index": INDEX, "flat_side": "scene",
    }  # fmt: skip
    run("calibrate", converted, tmp_path / "c.json", "--model", "exact")
    found = Calibration.load(tmp_path / "c.json")
    away = Prism(found.parameters["apex"], INDEX).deflection - Prism(APEX, INDEX).deflection
    assert abs(away) * found.camera.fx < 0.1  # px, for an orbit with a radius of 1.2 px
    assert found.prism.index == INDEX


def test_an_apex_that_was_given_and_is_wrong_is_still_refused(bare: Recording) -> None:
    with pytest.raises(AmiwarpError, match="of its nominal apex"):
        calibrate(replace(bare, prism=Prism(math.radians(2.0), INDEX)), model="exact")


def test_streams_and_the_viewer_know_a_prism_without_apex(bare: Recording) -> None:
    prism = UnsizedPrism(INDEX, FlatSide.CAMERA)
    assert read_prism(prism_attributes(prism), "here") == prism
    shown = Inspector(replace(bare, prism=prism))
    assert (shown.prism.index, shown.prism.flat_side) == (INDEX, FlatSide.CAMERA)
