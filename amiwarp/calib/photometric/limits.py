"""Limits of what the photometric stage accepts and reports.

Each was set by failures that it prevents; ``docs/explanation/stability.md`` describes them.
"""

LARGEST_MOVE_PX = 1.5
"""Largest accepted distance between the optima of the photometric and the sharpness stage, in the prism's parameters
[px]."""
PERTURBATION_PX = 0.3
"""Change of the prism's orbit that must raise the cost [px]."""
LEAST_COST_RISE = 0.01
"""Rise of the cost by this change below which the optimum is refused.

Without such a rise there is no distinct optimum, or a brightness map of few events fits any orbit. The cost is relative
to that without a brightness map.
"""
RISE_SHARE = 0.1
SMALLEST_RISE = 0.003
"""A rise below ``LEAST_COST_RISE`` suffices if it is this share of the cost, and at least ``SMALLEST_RISE``.

Few edges leave a small cost, and small rises. In recordings that determined the orbit the share was 0.11 to 0.25, in
those that did not, 0.02 at most.
"""
LARGEST_NEXT_STEP_PX = 0.06
"""Largest Gauss-Newton step that may remain when the search ends [px]. The step is about 0.01 px if the search
converged."""
LARGEST_COST = 0.75
"""Largest accepted cost, relative to the cost without a brightness map. Above it the map explains too little of the
events."""
LARGEST_EXAMINED_COST = 0.5
"""Largest cost, relative to the cost without a map, of an answer that is examined for causes of an error."""
LARGEST_STILL_COST = 0.2
"""Largest cost of the photometric stage, relative to the cost without a map, that a still camera and a correct
encoder scale leave."""
LARGEST_ROTATION_GAIN = 0.05
"""Largest share of the squared residuals that a camera rotation may explain before it is freed. Cameras that turned at
0.1 to 1 deg/s left 0.1 to 0.5; still ones 0.007 at most, whatever the noise."""
LARGEST_COST_RATIO = 0.75
"""Ratio of the new to the previous cost up to which another explanation is accepted if the previous cost was high: a
camera rotation, a corrected encoder scale, or a corrected lens."""
NOTABLE_GAIN = 0.005
"""Share of the squared residuals above which a cause is reported, however little it moves. Right answers leave 0.001
at most; a lens with k1 = -0.06 that was not given left 0.013, moved the model by 0.025 px and was 0.065 px off."""
NOTABLE_CLOCK_PX = 0.008
"""Smallest drift of the phase against an encoder that is reported [px]. It is about a third of the error: a clock that
was wrong by 0.2 % drifted by 0.010 px, and was 0.029 px off."""
NOTABLE_PX = 0.025
"""Smallest drift, or spread over the image, of the orbit's size and phase that is reported [px]."""
LARGEST_INCONSISTENCY_PX = 0.1
"""Largest accepted error that the check of the answer's consistency leaves [px]."""
NOTABLE_BLIND_PX = 0.4
LARGEST_BLIND_PX = 0.47
"""Motion of the image by a vibration or a mirror within the refractory period above which it is reported, and refused
[px]. With 0.48 px errors were at most 0.025 px, with 0.51 px 0.028 px, and with 0.6 px 0.047 px."""
NOTABLE_STATED_PX = 0.025
LARGEST_STATED_PX = 0.03
"""Error of a vibration or a mirror that the answer's covariance states above which it is reported, and refused [px
rms]. In 60 simulations of 640×480 px, every answer with an error over 0.02 px stated at least 0.03 px, except two that
are refused for their speed and one for the doubt about the refractory period."""
FEW_EVENTS = 75_000
NOTABLE_DEVIATION_PX = 0.01
"""Number of events of a recording below which they are said to be few, if the standard deviation of the motion is at
least this [px rms]. Of nine wedges with 10,000 to 50,000 events, two were over 0.02 px off. They stated 0.011 and 0.015
px; six of the others stated less than 0.007 px."""
LARGEST_CHANGE_OF_SPEED_PX = 0.01
"""Largest accepted change of a vibration's frequency over a recording, as motion of events by a linearised fit, which
finds a share of it [px rms]."""
LARGEST_LAG_RAD = 0.35
"""Largest angle by which the prism may turn within the time constant of slow photoreceptors [rad]. At 0.2 an error of
0.02 px remains, at 0.4 one of 0.14 px."""
LARGEST_SLOW_PX = 0.2
"""Largest correction for slow photoreceptors [px rms]. About a tenth of it remains: up to 0.06 px in weak and fine
texture, where the correction is 0.3 to 0.4 px."""
REFRACTORY_DOUBT_US = 100.0
"""Standard deviation of the refractory period of a sensor whose period is not given [us], for a vibrating camera: its
image moves too fast for the events to tell the period."""
KNOWN_SHARE = 0.3
"""Standard deviation of a period that is given, as a share of it: it stands for the jitter of the time stamps too. A
period that is given as 0 is known not to be there."""
NOTABLE_DOUBT_PX = 0.008
LARGEST_DOUBT_PX = 0.015
"""Change of an answer by the doubt about this period above which it is reported, and refused [px rms]."""
NOTABLE_SKEW_PX = 0.02
LARGEST_SKEW_PX = 0.04
"""Errors by pixels that are read one after another, above which they are reported and refused [px rms]. Compensation
does not correct them."""
NOTABLE_SECTOR_PX = 0.02
"""Smallest error that repeats with an angle and is not corrected, and is reported [px rms]. Right angles of a wedge
leave 0.007 at 320x240, and nearly 0.02 in short recordings at 160x120; third harmonics that were 0.05 px off left 0.02
to 0.06."""
NOTABLE_RIVAL_PX = 0.02
LARGEST_RIVAL_PX = 0.06
"""Distance of the models of two explanations above which both are reported, and above which the answer is refused
[px rms]. A wobble of 2 degrees and cylinder power are 0.05 px apart."""
CONTRADICTING = 3.0
"""Number of standard deviations above which a correction is said to contradict what was given."""
LEAST_SILENCE = 0.05
"""Share of the time without events above which it is reported: the turns are not whole."""
NOTABLE_STEP = 0.12
LARGEST_STEP = 0.2
"""Median change of brightness beyond one threshold between the two events of a pair above which lost events are
reported, and above which the answer is rejected [thresholds].

It is 0.03 for a sensor that loses nothing, 0.07 for one that loses a fifth of its events, 0.2 for a third, 0.3 for half
of them; then the answer is off by 0.06 px. Slow pixels leave 0.1, a third of noise 0.2: only the residuals of pairs
between which an event is missing tell loss from noise, see ``losses.py``.
"""


def is_far(moved_px: float) -> bool:
    """Return whether an answer lies so far from the one of the sharpness stage that it is refused [px]."""
    return moved_px > 0.95 * LARGEST_MOVE_PX
