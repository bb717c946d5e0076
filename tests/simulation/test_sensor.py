"""The sensor model against analytic answers and plain-Python oracles: photoreceptor, noise, leak, rows and bus."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraMotion,
    Events,
    EventSensor,
    Prism,
    PrismMotion,
    Scene,
    SensorModel,
    Simulation,
    simulate,
)
from amiwarp.kernels import photoreceptors, pixels
from amiwarp.simulation import DARK
from amiwarp.simulation.commands.rig_options import SensorOptions
from reference import second_simulator

CAMERA = Camera.from_fov(64, 48, math.radians(50.0))
PRISM = Prism(math.radians(3.0), 1.55)
WIDE = Prism(0.0, 1.55)  # no deflection at all
SLOPE = 4.0  # log intensity per unit of the picture plane
FOV = math.radians(100.0)


def quiet_sensor(**changes: float | None) -> SensorModel:
    return replace(SensorModel.ideal(), **changes)  # type: ignore[arg-type]


def events_of(
    simulation: Simulation, chunk_us: int | None = None
) -> tuple[Events, NDArray[np.float32]]:
    parts = list(simulation.blocks(chunk_us=chunk_us))
    return Events.concatenate([e for e, _ in parts]), np.concatenate([p for _, p in parts])


def texture() -> Scene:
    light = np.random.default_rng(1).uniform(0.05, 1.0, (24, 32))
    return Scene.from_picture(np.kron(light, np.ones((4, 4))).astype(np.float32))


def seen_through_prism(sensor: SensorModel, device: str = "cpu", **changes: Any) -> Simulation:
    return replace(
        Simulation(texture(), CAMERA, PRISM, 0.06, sensor=sensor, seed=3, device=device), **changes
    )


def still(sensor: SensorModel, duration: float, device: str, light: float = 0.5) -> Events:
    """Events of a picture without contrast, so of noise alone."""
    scene = Scene.from_picture(np.full((8, 8), light, np.float32))
    return events_of(
        Simulation(
            scene, CAMERA, WIDE, duration, motion=PrismMotion(0.0), sensor=sensor, device=device
        )
    )[0]


# -- photoreceptor


@dataclass
class Switch:
    """A picture without contrast whose luminance changes from one value to another."""

    lights: tuple[float, float]
    at: int = 10_000
    rise: int = 100
    interval_us: float = 400.0  # steps of 100 us
    size: tuple[int, int] = (8, 8)

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        for t, light in ((0, 0), (self.at, 0), (self.at + self.rise, 1), (10**9, 1)):
            yield t, np.full((8, 8), self.lights[light], np.float32)


@pytest.mark.parametrize("light", [1.0, 0.4, 0.05])
def test_a_step_of_light_is_answered_exponentially(device: str, light: float) -> None:
    """After the step the level nears its end as exp(-t / tau), tau proportional to 1 / (luminance + dark)."""
    cutoff, contrast = 100.0, 0.05
    simulation = Simulation(
        Scene(Switch((0.2, light))), CAMERA, WIDE, 0.2, motion=PrismMotion(0.0), device=device,
        sensor=quiet_sensor(cutoff_hz=cutoff, contrast_on=contrast, contrast_off=contrast),
    )  # fmt: skip
    events, _ = events_of(simulation)
    found = events.t[(events.x == 20) & (events.y == 30)].astype(np.float64)
    assert set(events.p.tolist()) == {int(light > 0.2)}
    total = abs(math.log((light + DARK) / (0.2 + DARK)))
    left = total - contrast * np.arange(1, int(total / contrast) + 1)
    tau_us = 1e6 / (2.0 * math.pi * cutoff) * (1.0 + DARK) / (light + DARK)
    first = 2 if len(left) > 4 else 1  # crossed after the rise of 100 us
    expected = tau_us * np.log(left[first] / left[first:])
    near_end = left[first:] > 0.02  # the last crossings may come late or never
    n = int(near_end.sum())
    assert n >= 4
    # Us
    np.testing.assert_allclose(
        (found[first:] - found[first])[:n], expected[:n], rtol=0.02, atol=5.0
    )


def ramp() -> Scene:
    """Log intensity SLOPE * x on the picture plane, x = tan(angle off the axis)."""
    half = math.tan(FOV / 2.0)
    x = (np.arange(1200) + 0.5) / 1200 * 2.0 * half - half
    light = np.exp(SLOPE * (x + half)) * 0.5 - DARK
    return Scene.from_picture(np.tile(light, (20, 1)).astype(np.float32), fov=FOV, blur=0.0)


def crossing_times(
    angle: float,
    rate: float,
    cutoff: float,
    contrast: float,
    duration: float,
    buffer: float = 0.0,
) -> NDArray[np.float64]:
    """Times at which the photoreceptor of one pixel crosses its thresholds [us], by SciPy's solver in float64.

    ``buffer``: cut-off frequency of its second stage [Hz]; 0 for one stage.
    """

    def light_level(t: float) -> float:
        return SLOPE * (math.tan(angle + rate * t) + math.tan(FOV / 2.0)) + math.log(0.5)

    def change(t: float, y: NDArray[np.float64]) -> list[float]:
        x = light_level(t)
        first, second = y
        return [
            2.0 * math.pi * cutoff * math.exp(x) / (1.0 + DARK) * (x - first),
            2.0 * math.pi * buffer * (first - second),
        ]

    t = np.arange(0.0, duration, 2e-6)
    start = light_level(0.0)
    y = solve_ivp(
        change, (0.0, duration), [start, start], t_eval=t, method="LSODA", rtol=1e-8, atol=1e-8
    ).y[1 if buffer else 0]
    crossed = np.searchsorted(
        np.floor((y - start) / contrast), np.arange(1, int((y[-1] - start) / contrast) + 1)
    )
    return t[crossed] * 1e6


@pytest.mark.parametrize("longest_us", [2000, 137])
@pytest.mark.parametrize("buffer", [0.0, 40.0, 1000.0])
def test_filtered_ramp_agrees_with_a_solver_for_any_step(
    device: str, buffer: float, longest_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Time constants of the first stage are 160 us to 1.8 ms, in the steps of two lengths."""
    monkeypatch.setattr("amiwarp.simulation.image_motion.LONGEST_STEP", longest_us)
    rate, contrast, duration, cutoff = 1.0, 0.2, 0.1, 10.0
    sensor = quiet_sensor(
        cutoff_hz=cutoff, buffer_hz=buffer, contrast_on=contrast, contrast_off=contrast
    )
    recording = simulate(ramp(), CAMERA, WIDE, duration_s=duration, motion=0.0, device=device,
                         camera_motion=CameraMotion((0.0, rate, 0.0)), sensor=sensor)  # fmt: skip
    events = recording.events.slice(0, len(recording.events))
    for column in (0, 17, 40):
        expected = crossing_times(
            math.atan((column - CAMERA.cx) / CAMERA.fx), rate, cutoff, contrast, duration, buffer
        )
        found = events.t[(events.x == column) & (events.y == 24)]
        n = min(len(found), len(expected))
        assert n >= 1
        assert abs(len(found) - len(expected)) <= 1
        np.testing.assert_allclose(found[:n], expected[:n], rtol=0, atol=25.0)  # us


@pytest.mark.parametrize(("light", "cutoff"), [(1.0, 0.0), (1.0, 60.0), (0.05, 2000.0)])
def test_a_step_of_light_passes_two_stages(device: str, light: float, cutoff: float) -> None:
    """The answer of two low-pass filters in a row to a step, in closed form; the first may be unlimited."""
    buffer, contrast, last = 200.0, 0.05, 0.03
    simulation = Simulation(
        Scene(Switch((0.2, light))), CAMERA, WIDE, 0.2, motion=PrismMotion(0.0), device=device,
        sensor=quiet_sensor(
            cutoff_hz=cutoff, buffer_hz=buffer, contrast_on=contrast, contrast_off=contrast
        ),
    )  # fmt: skip
    events, _ = events_of(simulation)
    found = events.t[(events.x == 20) & (events.y == 30)].astype(np.float64)
    total = abs(math.log((light + DARK) / (0.2 + DARK)))
    rates = [2.0 * math.pi * buffer]
    if cutoff:
        rates.append(2.0 * math.pi * cutoff * (light + DARK) / (1.0 + DARK))
    t_us = np.arange(0.0, 100_000.0)
    weights = (
        [1.0]
        if not cutoff
        else [rates[1] / (rates[1] - rates[0]), rates[0] / (rates[0] - rates[1])]
    )
    answer = total * (
        1.0 - sum(w * np.exp(-r * t_us * 1e-6) for w, r in zip(weights, rates, strict=True))
    )
    levels = contrast * np.arange(1, int((total - last) / contrast) + 1)
    expected = np.searchsorted(answer, levels)
    assert len(levels) > 8
    # Us, from the fourth crossing on, because the light of the rise of 100 us has another bandwidth
    np.testing.assert_allclose(
        found[3 : len(levels)] - found[3], expected[3:] - expected[3], rtol=0.005, atol=5.0
    )


def test_a_long_step_is_divided_for_the_second_stage(device: str) -> None:
    """A jump of light, then a step of two time constants of a buffer: crossings along an exponential, no chord."""
    buffer, jump = 300.0, 2.0
    sensor = EventSensor(1, 1, 1, quiet_sensor(buffer_hz=buffer, contrast_on=0.1), device=device)
    found = []
    for t_us, level in ((0, 0.0), (2, jump), (1002, jump)):
        events, _ = sensor.step(np.full((1, 1), level, np.float32), t_us)
        found += events.t.numpy().tolist()
    tau_us = 1e6 / (2.0 * math.pi * buffer)
    reached = jump * (1.0 - math.exp(-1001.0 / tau_us))
    levels = 0.1 * np.arange(1, int(reached / 0.1) + 1)
    expected = 1.0 - tau_us * np.log(1.0 - levels / jump)
    assert len(expected) > 15
    np.testing.assert_allclose(found, expected, rtol=0, atol=6.0)  # us


def test_both_stages_agree_with_the_second_simulator() -> None:
    """The same scene's light at one pixel, through the second simulator's filters."""
    rng = np.random.default_rng(4)
    levels = np.cumsum(rng.normal(0.0, 0.15, (300, 4, 5)), axis=0) - 2.0
    cutoff, buffer, step_us = 150.0, 400.0, 500
    model = quiet_sensor(
        cutoff_hz=cutoff, buffer_hz=buffer, contrast_on=0.1, contrast_off=0.1, refractory_us=0.0
    )
    sensor = EventSensor(1, 4, 5, model)
    sums = np.zeros((4, 5))
    first = levels[0].copy()
    second = levels[0].copy()
    sensor.step(levels[:1].astype(np.float32), 0)
    for k in range(1, len(levels)):
        events, _ = sensor.step(levels[k : k + 1].astype(np.float32), k * step_us)
        sign = 2.0 * events.p.numpy().astype(float) - 1.0
        np.add.at(sums, (events.y.numpy(), events.x.numpy()), 0.1 * sign)
        # A hundred pieces, in each of which the bandwidth is constant
        for j in range(100):
            start = levels[k - 1] + (levels[k] - levels[k - 1]) * j / 100
            end = levels[k - 1] + (levels[k] - levels[k - 1]) * (j + 1) / 100
            light = np.exp(0.5 * (start + end)) / (1.0 + DARK)
            new_first = second_simulator.low_pass(
                first, start, end, step_us * 1e-8, 1.0 / (2.0 * np.pi * cutoff * light)
            )
            second = np.asarray(
                second_simulator.low_pass(
                    second, first, new_first, step_us * 1e-8, 1.0 / (2.0 * np.pi * buffer)
                )
            )
            first = new_first
        # The events so far say the level to less than a threshold
        assert np.abs(sums - (second - levels[0])).max() < 0.1 + 0.004
    assert np.abs(levels[-1] - second).max() > 0.05


def test_wide_bandwidth_changes_nothing_and_narrow_bandwidth_loses_events(device: str) -> None:
    clear, _ = events_of(seen_through_prism(quiet_sensor(), device))
    wide, _ = events_of(seen_through_prism(quiet_sensor(cutoff_hz=1e6, buffer_hz=1e6), device))
    second, _ = events_of(seen_through_prism(quiet_sensor(buffer_hz=30.0), device))
    assert len(second) < 0.7 * len(clear)
    narrow, _ = events_of(seen_through_prism(quiet_sensor(cutoff_hz=30.0), device))
    assert len(wide) == pytest.approx(len(clear), rel=2e-3)
    assert len(narrow) < 0.5 * len(clear)


def test_filter_computed_ahead_gives_the_same_events(monkeypatch: pytest.MonkeyPatch) -> None:
    sensor = SensorModel(
        cutoff_hz=300.0,
        buffer_hz=500.0,
        shot_noise_hz=30.0,
        leak_hz=5.0,
        leak_jitter_fraction=0.2,
    )
    simulation = seen_through_prism(sensor, motion=PrismMotion(-720.0, tilt=(0.02, 0.01)))
    ahead, _ = events_of(simulation)
    monkeypatch.setattr(
        photoreceptors, "run_filtered_pixels_ahead", photoreceptors.run_filtered_pixels
    )
    same_events(ahead, events_of(simulation)[0])


def test_without_a_cutoff_the_kernels_have_no_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    assert SensorModel(cutoff_hz=None) == SensorModel()
    monkeypatch.delattr(photoreceptors, "run_filtered_pixels_ahead")
    events_of(seen_through_prism(SensorModel()))


def same_events(a: Events, b: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


EVERYTHING = SensorModel(
    cutoff_hz=500.0, shot_noise_hz=20.0, shot_noise_dark=4.0, leak_hz=5.0, leak_jitter_fraction=0.3,
    noise_rate_cov_decades=0.2, row_us=10.0, bus_rate_mev_s=0.3, bus_queue=200.0,
)  # fmt: skip


@pytest.mark.parametrize("chunk_us", [3000, 17001])
def test_chunks_and_room_do_not_matter_with_everything_on(
    device: str, chunk_us: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulation = seen_through_prism(EVERYTHING, device)
    whole, points = events_of(simulation)
    # Runs out of room and starts over
    monkeypatch.setattr("amiwarp.simulation.key_buffer.EVENTS_PER_PIXEL", 1)
    parts, part_points = events_of(simulation, chunk_us)
    same_events(whole, parts)
    np.testing.assert_array_equal(points, part_points)
    assert len(whole) > 1000
    assert (np.diff(whole.t) >= 0).all()


# -- noise and leak


@pytest.mark.parametrize("light", [0.0, 0.3, 1.0, 5.0])
def test_shot_noise_falls_linearly_with_light(device: str, light: float) -> None:
    sensor = quiet_sensor(shot_noise_hz=50.0, shot_noise_dark=4.0)
    expected = 50.0 * (4.0 - 3.0 * min(light, 1.0)) * 64 * 48 * 0.2
    events = still(sensor, 0.2, device, light)
    assert abs(len(events) - expected) < 5.0 * math.sqrt(expected)
    assert abs(events.p.mean() - 0.5) < 0.02


def test_hot_pixels_do_not_depend_on_light(device: str) -> None:
    sensor = quiet_sensor(hot_fraction=1.0, hot_hz=100.0, shot_noise_hz=50.0, shot_noise_dark=4.0)
    expected = 150.0 * 64 * 48 * 0.2
    assert abs(len(still(sensor, 0.2, device, 1.0)) - expected) < 5.0 * math.sqrt(expected)


@pytest.mark.parametrize(
    ("jitter", "duration", "spread", "mean"), [(0.1, 1.0, 0.103, 1.010), (0.3, 4.0, 0.549, 1.138)]
)
def test_leak_jitter_is_the_spread_of_the_rate(
    device: str, jitter: float, duration: float, spread: float, mean: float
) -> None:
    """Expected intervals: integrals over a normal distribution of the rate, raised to a tenth of the mean below it."""
    events = still(quiet_sensor(leak_hz=20.0, leak_jitter_fraction=jitter), duration, device)
    pixel = events.y.astype(int) * 64 + events.x
    order = np.lexsort((events.t, pixel))
    gaps = np.diff(events.t[order])[np.diff(pixel[order]) == 0]
    assert events.p.min() == 1
    assert gaps.std() / gaps.mean() == pytest.approx(spread, rel=0.05)
    assert gaps.mean() == pytest.approx(50_000.0 * mean, rel=0.01)  # us


def test_rates_differ_between_pixels_by_decades(device: str) -> None:
    for sensor in (quiet_sensor(leak_hz=500.0, noise_rate_cov_decades=0.2),
                   quiet_sensor(shot_noise_hz=500.0, noise_rate_cov_decades=0.2)):  # fmt: skip
        events = still(sensor, 0.4, device)
        counts = np.bincount(events.y.astype(int) * 64 + events.x, minlength=64 * 48)
        decades = np.log10(np.maximum(counts, 1))
        assert decades.std() == pytest.approx(0.2, rel=0.08)
        assert 10.0 ** np.median(decades) == pytest.approx(200.0, rel=0.05)


# -- readout


def test_events_queue_for_the_bus_as_in_a_plain_walk(device: str) -> None:
    rate, queue = 0.4, 300
    sensor = quiet_sensor(contrast_on=0.1, contrast_off=0.1)
    free, free_points = events_of(seen_through_prism(sensor, device))
    simulation = seen_through_prism(
        replace(sensor, bus_rate_mev_s=rate, bus_queue=float(queue)), device
    )
    found, points = events_of(simulation)
    until, kept, stamps = 0, [], []
    for k, t in enumerate((free.t * 1_000_000).tolist()):  # ps
        if until - t <= queue * 2_500_000:
            begin = max(until, t)
            until = begin + 2_500_000
            if begin // 1_000_000 < simulation.duration_us:
                kept.append(k)
                stamps.append(begin // 1_000_000)
    assert len(kept) < 0.8 * len(free)
    assert found.t.tolist() == stamps
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(free, name)[kept])
    np.testing.assert_array_equal(points, free_points[kept])  # of the crossing, not of the readout
    for window in (10, 100, 1000):  # us
        within = np.searchsorted(found.t, found.t + window) - np.arange(len(found))
        assert within.max() <= rate * window + 1
    delay = np.array(stamps) - free.t[kept]
    assert delay.max() <= queue / rate + 1  # us
    assert delay.max() > 0.9 * queue / rate


def test_a_fast_bus_delays_nothing(device: str) -> None:
    free, _ = events_of(seen_through_prism(SensorModel(), device))
    bus, _ = events_of(seen_through_prism(SensorModel(bus_rate_mev_s=1e5), device))
    same_events(free, bus)


@pytest.mark.parametrize("row_us", [20.0, 0.37])
def test_rows_are_read_in_turn(device: str, row_us: float) -> None:
    sensor = quiet_sensor(contrast_on=0.1, contrast_off=0.1)
    free, _ = events_of(seen_through_prism(sensor, device))
    rows, _ = events_of(seen_through_prism(replace(sensor, row_us=row_us), device))
    scan = 48 * row_us
    phase = np.arange(48) * row_us
    number = np.ceil(np.round((free.t - phase[free.y]) / scan, 9))
    due = np.ceil(np.round(number * scan + phase[free.y], 6)).astype(np.int64)
    taken: set[tuple[int, int, int]] = set()
    expected = []
    for k in np.lexsort((free.t, free.y.astype(int) * 64 + free.x, due)).tolist():
        place = (int(due[k]), int(free.x[k]), int(free.y[k]))
        if place not in taken and due[k] < 60_000:
            taken.add(place)
            expected.append((*place, int(free.p[k])))
    found = list(
        zip(rows.t.tolist(), rows.x.tolist(), rows.y.tolist(), rows.p.tolist(), strict=True)
    )
    assert found == expected
    assert len(found) > 10_000


def test_a_busy_bus_keeps_rows_together(device: str) -> None:
    sensor = quiet_sensor(
        contrast_on=0.1, contrast_off=0.1, row_us=20.0, bus_rate_mev_s=0.4, bus_queue=300.0
    )
    events, _ = events_of(seen_through_prism(sensor, device))
    assert (np.diff(events.t) >= 0).all()
    changes = np.flatnonzero((np.diff(events.t) != 0) | (np.diff(events.y.astype(int)) != 0))
    assert len(changes) < 0.5 * len(events)  # several events share a row and a time stamp
    assert len(events) <= 0.4 * 60_000 + 64  # events; the last row may begin before the end


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cutoff_hz": -1.0}, "cutoff_hz = -1"),
        ({"cutoff_hz": 1e-9}, "or 0 for none"),
        ({"buffer_hz": 2e7}, "buffer_hz = 20000000.0"),
        ({"shot_noise_dark": 0.5}, "shot_noise_dark = 0.5"),
        ({"bus_rate_mev_s": 1e9}, "bus_rate_mev_s"),
        ({"bus_queue": math.nan}, "bus_queue = nan"),
        ({"leak_jitter_fraction": 0.31}, r"leak_jitter_fraction = 0.31 .* 0 \.\. 0.3"),
    ],
)
def test_values_out_of_range_are_refused(values: dict[str, float], message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        SensorModel(**values)


def test_a_scan_that_takes_too_long_is_refused() -> None:
    with pytest.raises(AmiwarpError, match="give a smaller row_us"):
        events_of(seen_through_prism(quiet_sensor(row_us=1000.0)))


# -- presets


CAMERAS = ("dvxplorer", "dvxplorer_mini", "davis240c", "davis346", "gen4", "evk4", "genx320")


@pytest.mark.parametrize("name", CAMERAS)
def test_presets_make_events(name: str) -> None:
    sensor = SensorModel.preset(name)
    events, _ = events_of(seen_through_prism(sensor))
    assert len(events) > 10_000
    assert sensor.cutoff_hz
    assert sensor.bus_rate_mev_s or name == "genx320"  # no figure is public


def test_half_of_the_dvxplorer_s_pixels_respond_at_13_percent_and_nearly_all_at_27_5_percent() -> (
    None
):
    sensor = SensorModel.preset("dvxplorer")
    thresholds = NormalDist(sensor.contrast_on, sensor.mismatch * sensor.contrast_on)
    assert thresholds.cdf(math.log(1.13)) == pytest.approx(0.5)
    assert thresholds.cdf(math.log(1.275)) == pytest.approx(0.999, abs=2e-5)


def test_the_background_of_a_davis240c_is_the_published_one() -> None:
    """0.1 events of a pixel per second in bright light, without the hot pixels; shot noise of 5 in the dark."""
    sensor = replace(SensorModel.preset("davis240c"), hot_fraction=0.0)
    pixels_s = CAMERA.width * CAMERA.height * 10.0
    bright = still(sensor, 10.0, "cpu", light=1.0)
    assert len(bright) / pixels_s == pytest.approx(0.1, rel=0.1)
    assert np.mean(bright.p == 1) > 0.9  # leaks
    dark = still(sensor, 1.0, "cpu", light=0.0)
    # Each random event sets the reference, which leaves no time for leaks
    assert len(dark) / pixels_s * 10.0 == pytest.approx(5.0, rel=0.05)
    assert np.mean(dark.p == 1) == pytest.approx(0.5, abs=0.02)


def test_thresholds_of_bias_currents() -> None:
    """Each factor of e of the currents moves a threshold by 1 / (0.7 * 20)."""
    sensor = SensorModel.preset("davis346").with_davis_biases(2.0, 2.0 * math.e**3, 2.0 / math.e)
    assert sensor.contrast_on == pytest.approx(3.0 / 14.0)
    assert sensor.contrast_off == pytest.approx(1.0 / 14.0)
    assert sensor.mismatch == SensorModel.preset("davis346").mismatch
    for biases in ((1.0, 0.5, 0.1), (1.0, 2.0, 1.5), (1.0, 2.0, 0.0)):
        with pytest.raises(AmiwarpError, match="bias current"):
            SensorModel().with_davis_biases(*biases)


def test_an_unknown_preset_names_the_known_ones() -> None:
    with pytest.raises(AmiwarpError, match=", ".join(CAMERAS)):
        SensorModel.preset("eye")


def test_options_change_a_preset() -> None:
    found = SensorOptions(sensor="gen4", bus_rate_mev_s=4.0, cutoff_hz=0.0).build()
    assert found == replace(SensorModel.preset("gen4"), bus_rate_mev_s=4.0, cutoff_hz=0.0)
    assert SensorOptions().build() == SensorModel()
    assert SensorOptions(ideal=True, row_us=2.0).build() == quiet_sensor(row_us=2.0)
    with pytest.raises(AmiwarpError, match="give one of them"):
        SensorOptions(ideal=True, sensor="gen4").build()


def test_a_recording_stores_the_sensor() -> None:
    parameters = seen_through_prism(
        SensorModel(cutoff_hz=None, bus_rate_mev_s=3)
    ).truth_parameters()
    assert parameters["cutoff_hz"] == 0.0
    assert parameters["bus_rate_mev_s"] == 3.0
    assert {type(value) for value in parameters.values()} == {float}


def test_causes_of_noise_are_kept(device: str) -> None:
    """A leak in a piece of a step is recognised, and so is a hot pixel in a sensor with uneven noise."""
    from amiwarp.simulation.engine import Engine

    sensor = quiet_sensor(
        leak_hz=100.0,
        cutoff_hz=300.0,
        shot_noise_hz=10.0,
        hot_fraction=0.1,
        hot_hz=50.0,
        noise_rate_cov_decades=0.3,
    )
    scene = Scene.from_picture(np.full((8, 8), 0.5, np.float32))
    simulation = Simulation(
        scene, CAMERA, WIDE, 0.2, motion=PrismMotion(0.0), sensor=sensor, device=device
    )
    cause = np.concatenate([block.arrays.cause.numpy() for block in Engine(simulation).run()])
    counts = np.bincount(cause, minlength=4) / (64 * 48 * 0.2)  # per pixel and second
    assert counts[int(pixels.SIGNAL)] == 0.0
    assert counts[int(pixels.LEAK)] > 50.0
    assert counts[int(pixels.SHOT_NOISE)] > 5.0
    assert counts[int(pixels.HOT_PIXEL)] == pytest.approx(0.1 * 62.0, rel=0.2)
