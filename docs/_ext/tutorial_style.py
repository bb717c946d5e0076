"""Look of the tutorials."""

from typing import Any


def reset(gallery_conf: dict[str, Any], fname: str) -> None:
    """Set the style of all figures."""
    import matplotlib

    matplotlib.rcParams.update(
        {
            "figure.figsize": (8.0, 3.6),
            "figure.constrained_layout.use": True,
            "font.size": 9.5,
            "image.cmap": "gray",
        }
    )
