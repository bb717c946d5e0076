"""What else may explain a wobble or a cylinder that was found: the other of the two, and the still part of a lens."""

import math
from dataclasses import replace

import numpy as np
import pytest

import amiwarp
from amiwarp.calib.uneven_prism import OTHER_SHAPE, one_sided_px, other_shape, with_rival_shape

CAMERA = amiwarp.Camera.from_fov(320, 240, math.radians(60.0))
PRISM = amiwarp.Prism(math.radians(1.0))


def test_a_wobble_moves_the_image_like_a_cylinder() -> None:
    wobbling = amiwarp.ExactModel(
        CAMERA, PRISM, 0.5, wobble=(math.radians(-0.684), math.radians(0.3))
    )
    rival = other_shape(wobbling, "wobble")
    assert rival.shape == "cylinder"
    assert rival.values[0] == pytest.approx(math.radians(0.0096), rel=0.02)
    assert rival.moving_px < 1e-3
    assert 0.01 < rival.still_px < 0.03
    back = other_shape(amiwarp.ExactModel(CAMERA, PRISM, 0.5, cylinder=rival.values), "cylinder")
    np.testing.assert_allclose(back.values, wobbling.wobble, rtol=0.06)


def test_the_lens_of_a_cylinder_on_one_side_is_that_of_a_prism_that_grows_with_the_distance() -> (
    None
):
    power, radius = math.radians(0.05), math.hypot(CAMERA.width, CAMERA.height) / math.sqrt(12.0)
    model = amiwarp.ExactModel(CAMERA, PRISM)
    moved = CAMERA.fx * amiwarp.deflection_from_apex(power * radius / CAMERA.fx, PRISM.index)
    assert one_sided_px(model, power) == pytest.approx(moved, rel=1e-3)


def test_the_rival_is_said_unless_the_user_chose(calibration: amiwarp.Calibration) -> None:
    values = {"wobble_x": math.radians(-1.0), "wobble_y": 0.0}
    found = replace(
        calibration,
        model_name="exact",
        parameters={**calibration.parameters, **values},
        uncertainty={**calibration.uncertainty, "wobble_x": 1e-3, "wobble_y": 1e-3},
    )
    examined = with_rival_shape(found, None)
    said = examined.warnings[-1]
    assert examined.warnings[:-1] == found.warnings
    assert (
        "instead of the wobble that was found, it may be that its faces are uneven (cylinder, 0."
        in said
    )
    assert "no event tells" in said.lower()
    assert "curved along one direction only" in said
    # the places at rest, which no event shows, are part of what could hide
    rival = other_shape(found.model, "wobble")  # type: ignore[arg-type]
    assert found.photometric is not None
    assert examined.photometric is not None
    assert OTHER_SHAPE not in found.photometric.hidden_px
    assert examined.photometric.hidden_px[OTHER_SHAPE] == pytest.approx(
        math.hypot(rival.moving_px, rival.still_px)
    )
    assert with_rival_shape(found, ("apex", "phase", "wobble_x", "wobble_y")) is found
    doubtful = replace(found, uncertainty={**found.uncertainty, "wobble_x": 1e-2})
    assert with_rival_shape(doubtful, None) is doubtful
    assert with_rival_shape(calibration, None) is calibration


@pytest.mark.slow
def test_a_calibration_of_uneven_faces_names_both() -> None:
    from pyvista.examples import mapfile

    motion = amiwarp.PrismMotion(720.0, 0.5, cylinder=(math.radians(0.01), 0.0))
    recording = amiwarp.simulate(mapfile, CAMERA, PRISM, duration_s=0.3, motion=motion)
    said = " ".join(amiwarp.calibrate(recording, model="exact").warnings)
    assert (
        "instead of the wobble that was found, it may be that its faces are uneven (cylinder, 0.0"
        in said
    )
    assert "curved along one direction only" in said
