"""A calibration by hand: the exact model with given parameters."""

from collections.abc import Mapping

from amiwarp import Calibration, Camera, Prism


def exact_calibration(camera: Camera, prism: Prism, parameters: Mapping[str, float]) -> Calibration:
    """Return a calibration of the exact model as if the search had found ``parameters``."""
    return Calibration(
        model_name="exact", camera=camera, prism=prism, parameters=parameters, uncertainty={}, free=(),
        sharpness_name="variance", sharpness_before=1.0, sharpness_after=2.0, stages=(), events=10, seconds=0.0,
    )  # fmt: skip
