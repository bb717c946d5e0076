"""Model of the sensor: an event camera's pixels and readout."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.simulation.sensor_presets import PRESETS
from amiwarp.validation import one_of, real

SLOPE_FACTOR = 0.7
"""Typical slope factor of a transistor below its threshold, by which DAVIS thresholds follow from bias currents."""
CAPACITOR_RATIO = 20.0
"""Ratio of the two capacitors of a DVS pixel, the amplification of its change detector."""


@guarded
@dataclass(frozen=True, slots=True)
class SensorModel:
    """Model of an event camera's pixels and readout.

    The default values describe a good sensor in good light, with fast biases. By default, the photoreceptors have
    unlimited bandwidth, noise does not depend on light, and every event is read out at once.

    Notes
    -----
    Photoreceptor, leak and shot noise follow v2e (Y. Hu, S.-C. Liu and T. Delbruck, "v2e: From Video Frames to
    Realistic DVS Events", CVPR Workshops 2021). The second stage follows P. Lichtsteiner, C. Posch and T. Delbruck, "A
    128x128 120 dB 15 us Latency Asynchronous Temporal Contrast Vision Sensor", IEEE JSSC 43(2), 2008, and R. Graca, B.
    McReynolds and T. Delbruck, "Shining light on the DVS pixel", CVPR Workshops 2023.

    Examples
    --------
    >>> amiwarp.SensorModel(contrast_on=0.2).contrast_off
    0.25
    """

    contrast_on: float = 0.25
    """ON threshold: increase of natural log intensity that causes an ON event."""
    contrast_off: float = 0.25
    """OFF threshold: decrease of natural log intensity that causes an OFF event."""
    mismatch: float = 0.03
    """Relative standard deviation of the ON and OFF thresholds between pixels, 0 to 0.5.

    The thresholds of a pixel are normally distributed and independent, but never below a tenth of the nominal ones. At
    0.3, 0.1 % of the thresholds lie at this limit, at 0.5, 3.6 %.
    """
    refractory_us: float = 100.0
    """Refractory period: time after an event in which the pixel is blind [us].

    The new reference of the pixel is the brightness at the end of this period.
    """
    latency_us: float = 100.0
    """Mean time from a brightness change to the time stamp of its event [us]."""
    latency_jitter_us: float = 30.0
    """Standard deviation of the latency [us]. The time stamps of one pixel stay in order."""
    leak_hz: float = 0.1
    """Rate of leak events [1/s]: ON events in constant light, caused by the drift of the pixel's reference."""
    shot_noise_hz: float = 1.0
    """Rate of random events per pixel due to shot noise [1/s]. Half of these events are ON.

    Each random event sets the pixel's reference to the present brightness.
    """
    hot_fraction: float = 0.0002
    """Fraction of the pixels that are hot: they fire additional random events."""
    hot_hz: float = 100.0
    """Additional rate of random events of a hot pixel [1/s]."""
    cutoff_hz: float | None = 0.0
    """Bandwidth of the photoreceptor at white [Hz], proportional to the light; 0 or None for unlimited bandwidth.

    The photoreceptor is a first-order low-pass filter of the log intensity, with the time constant
    ``1 / (2 pi cutoff)``. Its cut-off frequency is proportional to the luminance plus 0.02, the stray light and dark
    current that the simulator adds to every picture.
    """
    buffer_hz: float | None = 0.0
    """Bandwidth of the photoreceptor's second stage [Hz], whatever the light; 0 or None for unlimited bandwidth.

    The source follower behind a photoreceptor is another first-order low-pass filter, whose cut-off frequency a bias
    sets (bias_fo of Prophesee's sensors, PrSFBp of DAVIS). In bright light it limits the bandwidth, in the dark the
    first stage does.
    """
    shot_noise_dark: float = 1.0
    """Rate of random events in the dark, relative to that at white, 1 to 1000; v2e uses 4.

    The rate falls linearly with luminance from the dark to white.
    """
    leak_jitter_fraction: float = 0.0
    """Relative standard deviation of a pixel's leak rate, 0 to 0.3.

    The rate is drawn anew after each event of the pixel, and is never below a tenth of its mean. At 0.1, the times
    between leak events deviate as much, and 1 % fewer leak events occur. At 0.3, these times deviate by half of their
    mean, and 12 % fewer occur.
    """
    noise_rate_cov_decades: float = 0.0
    """Standard deviation of the decimal logarithm of the rates of leak and random events between pixels.

    The rates have a log-normal distribution whose medians are ``leak_hz`` and ``shot_noise_hz``.
    """
    row_us: float = 0.0
    """Time to read out a row [us]; 0 if every event is read out at once.

    The rows are read one after the other, from the first to the last and then from the first again, without a pause.
    The events of a row share the time stamp of their readout. If a pixel fires several times between two readouts, only
    the first event is kept. A scan of all rows must not take longer than 10 ms.
    """
    bus_rate_mev_s: float = 0.0
    """Largest rate of events that the bus transmits [million events/s]; 0 for unlimited.

    Events wait in a queue. The time stamp of an event is the time at which the bus transmits the event.
    """
    bus_queue: float = 4096.0
    """Largest number of events that wait in the queue of the bus. Further events are lost."""

    def __post_init__(self) -> None:
        limits = {"mismatch": 0.5, "refractory_us": 1e6, "latency_us": 1e4, "latency_jitter_us": 1e3, "leak_hz": 1e3,
                  "shot_noise_hz": 1e5, "hot_fraction": 1.0, "hot_hz": 1e5, "leak_jitter_fraction": 0.3,
                  "noise_rate_cov_decades": 1.0, "row_us": 1e4, "bus_queue": 1e9}  # fmt: skip
        for name, limit in limits.items():
            object.__setattr__(self, name, real(getattr(self, name), f"sensor {name}", 0.0, limit))
        for name, least, limit in (
            ("cutoff_hz", 0.01, 1e7),
            ("buffer_hz", 0.01, 1e7),
            ("bus_rate_mev_s", 1e-3, 1e5),
        ):
            object.__setattr__(
                self, name, _real_or_none(getattr(self, name), f"sensor {name}", least, limit)
            )
        object.__setattr__(
            self, "shot_noise_dark", real(self.shot_noise_dark, "sensor shot_noise_dark", 1.0, 1e3)
        )
        for name in ("contrast_on", "contrast_off"):
            value = real(getattr(self, name), f"sensor {name}", 0.01, 10.0, " (log intensity)")
            object.__setattr__(self, name, value)

    @classmethod
    def ideal(cls, contrast: float = 0.25) -> SensorModel:
        """Return a sensor with equal thresholds and without noise, mismatch, latency and refractory period.

        Parameters
        ----------
        contrast : float, optional
            ON and OFF threshold [log intensity].

        Returns
        -------
        SensorModel
            The sensor model.
        """
        return cls(contrast, contrast, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def preset(cls, name: str) -> SensorModel:
        """Return the model of a known event camera at the manufacturer's biases in good light.

        Parameters
        ----------
        name : str
            Camera: ``dvxplorer``, ``dvxplorer_mini``, ``davis240c``, ``davis346``, ``gen4``, ``evk4`` or ``genx320``.

        Returns
        -------
        SensorModel
            The sensor model.

        Raises
        ------
        AmiwarpError
            If the name of the preset is unknown.

        Notes
        -----
        Contrast thresholds C are published as relative changes of light, (maximum - minimum) / minimum (Prophesee,
        "Event-based vision sensor characteristics"). The model uses ln(1 + C) for both polarities.

        ``dvxplorer``: iniVation DVXplorer, 640x480, 9 um pixels. Its data come from the manufacturer
        (docs.inivation.com, DVXplorer):

        - thresholds 13 %: at this contrast half of the pixels respond
        - mismatch 0.32: 99.9 % of the pixels respond at 27.5 %, which is 3.09 standard deviations of ln(1 + C) away
        - latency 200 us: published as "below 1 ms"; the number is a typical value, no source
        - row_us 0.4: a scan of 480 rows takes the published time resolution of 200 us; the chip scans columns
        - bus rate: 165 million events/s
        - cutoff_hz 1000, refractory_us 200, jitter, queue, leak and shot noise: typical values, no source

        ``dvxplorer_mini``: iniVation DVXplorer Mini, 640x480, 9 um pixels. The same thresholds and resolutions are
        published as of the DVXplorer; no other figure of its pixels is public. All values are taken from
        ``dvxplorer``, an assumption.

        ``davis240c``: iniVation DAVIS240C, 240x180, 18.5 um pixels.

        - thresholds 11 %, the smallest: C. Brandli et al., "A 240x180 130 dB 3 us Latency Global Shutter Spatiotemporal
          Vision Sensor", IEEE JSSC 49(10), 2014
        - latency 12 us at 1000 lux, bus rate 12 million events/s, and 0.1 noise events of a pixel per second, taken as
          the leak: G. Gallego et al., "Event-based Vision: A Survey", IEEE TPAMI 2022, table 1
        - mismatch 0.19 and cutoff_hz 3000: the standard deviation of 2.1 % contrast, and the bandwidth of 3 kHz at 1000
          lux, that P. Lichtsteiner et al. measured on an earlier chip (IEEE JSSC 43(2), 2008)
        - shot noise of 5 1/s in the dark: v2e's parameters for a noisy sensor. In bright light it is a thousandth, as
          the published 0.1 events are taken for the leak
        - refractory_us 500: default of v2e
        - jitter, queue: typical values, no source

        ``davis346``: iniVation DAVIS346, 346x260, 18.5 um pixels.

        - thresholds 14.3 % ON and 22.5 % OFF, at which half of the pixels respond: G. Gallego et al., as above
        - latency 20 us, the smallest; bus rate 12 million events/s: data sheet (inivation.com, DAVIS346.pdf)
        - mismatch 0.15, refractory_us 500 and cutoff_hz 300: defaults of v2e (standard deviation 0.03 of thresholds of
          0.2); the standard deviation of 2.1 % contrast of the earlier chip is 0.16 of the ON threshold
        - leak_hz 0.1: v2e's parameters for a noisy sensor
        - jitter, queue, shot noise: typical values, no source

        ``gen4``: Prophesee Gen4 and Sony IMX636, 1280x720, 4.86 um pixels.

        - thresholds 25 %, nominal: data of the camera EVK4 (Prophesee); the smallest threshold is lower
        - latency 100 us: published as "below 100 us at 1000 lux" (Prophesee, EVK4)
        - bus rate 1066 million events/s: T. Finateu et al., "A 1280x720 Back-Illuminated Stacked Temporal Contrast
          Event-Based Vision Sensor with 4.86 um Pixels, 1.066 GEPS Readout", ISSCC 2020; cameras with USB
          transmit less
        - cutoff_hz 2000, refractory_us 100, mismatch, jitter, queue, leak and shot noise: typical values, no source

        ``evk4``: Prophesee EVK4 with the Sony IMX636; values as of ``gen4``, except:

        - latency 220 us: typical at 25 % contrast, its manual
        - bus rate 50 million events/s: 1.6 Gbit/s by USB (Prophesee), if an event takes 32 bits; EVT 3.0 packs more
          densely

        ``genx320``: Prophesee GenX320, 320x320, 6.3 um pixels.

        - thresholds 30 %, nominal: the data sheet as quoted in Prophesee's forum ("RCT value of GENX320")
        - latency 150 us: published as "below 150 us at 1000 lux" (Prophesee)
        - no limit of the bus: no public figure
        - all other values are taken from ``gen4``, an assumption

        In all, the jitter of the leak and the spread of the noise rates are 0.1, as in v2e, and except in
        ``davis240c``, shot noise is four times as strong in the dark. Hot pixels have the default: typical values, no
        source. ``buffer_hz`` is unlimited: no public figure.

        Biases change these values. For DAVIS cameras :meth:`with_davis_biases` gives the thresholds. For the IMX636 and
        the GenX320 we know no public figure of the threshold or bandwidth that a bias gives: give ``contrast_on``,
        ``contrast_off``, ``buffer_hz`` and ``refractory_us`` themselves.

        Examples
        --------
        >>> amiwarp.SensorModel.preset("davis346").bus_rate_mev_s
        12.0
        """
        return cls(**PRESETS[one_of(name, PRESETS, "sensor preset")])

    def with_davis_biases(self, diff: float, on: float, off: float) -> SensorModel:
        """Return this sensor with the thresholds that bias currents of a DVS or DAVIS pixel give.

        Parameters
        ----------
        diff, on, off : float
            Currents of the biases DiffBn, OnBn and OffBn, in any common unit. OnBn is larger than DiffBn, and OffBn is
            smaller.

        Returns
        -------
        SensorModel
            The sensor model with other ``contrast_on`` and ``contrast_off``.

        Raises
        ------
        AmiwarpError
            If a current is not positive, or the order of the currents is another one.

        Notes
        -----
        The thresholds are (κn / κp²) (C2 / C1) ln(on / diff) and (κn / κp²) (C2 / C1) ln(diff / off). The slope factors
        κ are 0.7, and the ratio C1 / C2 of the pixel's capacitors is 20 (Y. Nozaki and T. Delbruck, "Temperature and
        Parasitic Photocurrent Effects in Dynamic Vision Sensors", IEEE TED 64(8), 2017; P. Lichtsteiner et al., IEEE
        JSSC 43(2), 2008). The slope factors are typical values, and the ratio is the ratio of the DVS128.

        Examples
        --------
        >>> sensor = amiwarp.SensorModel.preset("davis346").with_davis_biases(diff=1.0, on=10.0, off=0.1)
        >>> round(sensor.contrast_on, 3), round(sensor.contrast_off, 3)
        (0.164, 0.164)
        """
        diff = real(diff, "bias current diff", 1e-15, 1e15)
        on = real(on, "bias current on", 1e-15, 1e15)
        off = real(off, "bias current off", 1e-15, 1e15)
        if not off < diff < on:
            raise AmiwarpError(
                f"bias currents off, diff and on are {off:g}, {diff:g} and {on:g}; give rising ones, or "
                "the pixel fires without an end"
            )
        gain = SLOPE_FACTOR / SLOPE_FACTOR**2 / CAPACITOR_RATIO
        return replace(
            self, contrast_on=gain * math.log(on / diff), contrast_off=gain * math.log(diff / off)
        )


def _real_or_none(value: float | None, what: str, least: float, limit: float) -> float:
    """Return a value that must lie between ``least`` and ``limit``; return 0.0 if the value is None or 0."""
    number = 0.0 if value is None else real(value, what, 0.0, limit)
    return number if number == 0.0 else real(number, what, least, limit, " (or 0 for none)")


def named_sensor(name: str) -> SensorModel:
    """Return the sensor of a name in a file: ``default``, ``ideal``, or a preset of :class:`SensorModel`."""
    if name == "default":
        return SensorModel()
    if name == "ideal":
        return SensorModel.ideal()
    return SensorModel.preset(name)
