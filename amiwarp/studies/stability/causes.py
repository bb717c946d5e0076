"""Words that name the cause of a trouble in the warnings and refusals of a calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

CAUSES: dict[str, tuple[str, ...]] = {
    "eccentric_deg": ("encoder's angle is wrong", "repeats with"),
    "second_deg": ("encoder's angle is wrong", "repeats with"),
    "third_deg": ("encoder's angle is wrong", "repeats with"),
    "index_jitter_us": ("pulse",),
    "hunt": ("pulse", "speed"),
    "lost_once_deg": ("lost counts", "angle steps"),
    "swapped": ("swap", "exchange"),
    "command_cubic": ("command",),
    "command_square": ("command",),
    "third_px": ("harmonic",),
    "unsteady": ("amplitude",),
    "plate_wedge_arcmin": ("parallel", "wedge"),
    "noise": ("noise",),
    "window_events": ("few events",),
    "contrast": ("threshold", "contrast"),
    "camera_deg_s": ("turned", "turns", "rotat"),
    "distortion": ("k1", "lens", "distort"),
}
"""For each trouble, words one of which names it in a warning or a refusal. A clock of the encoder that seems wrong is
not its angle, and events that the sensor lost are no counts."""


def names_cause(texts: Sequence[str], troubles: Sequence[str]) -> bool:
    """Return whether a text names the cause of one of the troubles, which are fields of the condition."""
    words: list[str] = []
    for name in troubles:
        words += CAUSES.get(name, ())
    return has_word(texts, words)


def has_word(texts: Sequence[str], words: Sequence[str]) -> bool:
    """Return whether one of the texts has one of the words."""
    return any(word in text.lower() for word in words for text in texts)


def could_hide(hidden_px: Mapping[str, float], error_px: float) -> list[str]:
    """Return a text for each stated cause that may hide an error as large as this one [px rms].

    ``hidden_px`` are the stated bounds [px rms] by the words of their causes.
    """
    texts: list[str] = []
    for words, px in hidden_px.items():
        if px >= error_px:
            texts.append(f"could hide: {words} {px:.2g} px")
    return texts
