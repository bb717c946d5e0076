"""A small network against the solver: log intensity from the compensated events of a quarter turn.

    python -m benchmarks.network --out NETWORK.pt [--device cuda:0] train [--seconds 400] [--cameras 256] [--side 128]
    python -m benchmarks.network --out FILE.json [--device cuda:0] evaluate PICTURES [--figure FILE.png] [--seeds 20]

``train`` simulates worlds of textured leaves, half of them with moving bodies, behind a turning prism, by
:class:`amiwarp.EventSensor`, and trains on them for a time. No picture is used. ``evaluate`` shows the pictures of a
folder to the network in the package and to the solver, at rest and as backgrounds and bodies that move. It writes for
each row the SSIM of either method, and the time that it took, events on the device; of the network also the time for a
picture of a video.

The network in the package was trained for 380 s, then for 250 s with ``--start`` and ``--first 100000 --rate 1e-3
--cameras 96 --side 224 --pool 6144 --batch 24 --repeats 12``.

The inputs are those of :func:`amiwarp.learning.quarter_turn.sums_of_parts`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from scipy import ndimage
from skimage.metrics import structural_similarity
from torch import Tensor, nn
from torch.nn import functional

from amiwarp import (
    Camera,
    CircleModel,
    DeviceEvents,
    DeviceMemoryEvents,
    Encoder,
    EventSensor,
    ExactModel,
    Model,
    Network,
    PrismMotion,
    Reconstruction,
    Recording,
    Scene,
    SensorModel,
    Simulation,
    Windows,
    polarity_histogram,
    windows,
)
from amiwarp.imaging.metrics import TRUTH_PERCENTILES, picture_quality
from amiwarp.learning.quarter_turn import BINS, INPUTS, chords_of, sums_of_parts
from benchmarks.reconstruct import CAMERA, PHASE, PRISM, textured

STEPS = 4
"""Images that are drawn in each part of a quarter turn."""
WIDTH, LEVELS = 24, 5
"""Channels of each layer, and how often the size is halved."""
WHITE = 0.02
"""What is added to luminance before the logarithm."""


class UNet(nn.Module):  # type: ignore[misc]
    """Network from sums over compensated events to log intensity in thresholds, up to a constant."""

    def __init__(self) -> None:
        super().__init__()
        self.first = pair_of_layers(INPUTS, WIDTH)
        self.down = nn.ModuleList([pair_of_layers(WIDTH, WIDTH) for _ in range(LEVELS)])
        self.up = nn.ModuleList([nn.Conv2d(WIDTH, WIDTH, 3, padding=1) for _ in range(LEVELS)])
        self.last = nn.Conv2d(WIDTH, 1, 3, padding=1)

    def forward(self, given: Tensor) -> Tensor:
        """Return log intensity, shape (n, 1, H, W), from sums of shape (n, INPUTS, H, W)."""
        here = self.first(given)
        kept = [here]
        for layer in self.down:
            here = layer(functional.avg_pool2d(here, 2))
            kept.append(here)
        for k, layer in enumerate(self.up):
            wide = functional.interpolate(
                here, scale_factor=2.0, mode="bilinear", align_corners=False
            )
            here = functional.leaky_relu(layer(wide + kept[-2 - k]), 0.1)
        return self.last(here)


def pair_of_layers(given: int, width: int) -> nn.Sequential:
    """Return two convolutions with activations."""
    return nn.Sequential(nn.Conv2d(given, width, 3, padding=1), nn.LeakyReLU(0.1),
                         nn.Conv2d(width, width, 3, padding=1), nn.LeakyReLU(0.1))  # fmt: skip


# Worlds of flat, textured bodies.


def leaves(n: int, side: int, rng: torch.Generator, device: str) -> Tensor:
    """Return luminance of random overlapping leaves with gradients and textures, shape (n, 1, side, side)."""

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, device=device)

    frequency = torch.fft.fftfreq(side, device=device)
    radius = torch.hypot(frequency[:, None], frequency[None, : side // 2 + 1].abs()).clamp_min(
        1.0 / side
    )
    noise = torch.fft.rfft2(torch.randn(n, side, side, generator=rng, device=device))
    texture = torch.fft.irfft2(noise * radius ** -(0.6 + random(n, 1, 1)), s=(side, side))
    texture = texture / texture.std((1, 2), keepdim=True)
    y, x = (
        torch.linspace(-1.0, 1.0, side, device=device).view(*shape)
        for shape in ((1, side, 1), (1, 1, side))
    )
    level = 0.5 + 0.5 * x * (random(n, 1, 1) - 0.5) + 0.5 * y * (random(n, 1, 1) - 0.5)
    picture = level + 0.3 * random(n, 1, 1) * texture
    count = int(8 + 72 * torch.rand(1, generator=rng, device=device).item())
    for k in range(count):
        size = 0.6 * random(n, 1, 1) ** 2 * (1.0 - 0.7 * k / count) + 0.02
        cx, cy, turn = (
            2.4 * random(n, 1, 1) - 1.2,
            2.4 * random(n, 1, 1) - 1.2,
            math.tau * random(n, 1, 1),
        )
        u, v = (
            (x - cx) * turn.cos() + (y - cy) * turn.sin(),
            (y - cy) * turn.cos() - (x - cx) * turn.sin(),
        )
        slim = 0.1 + 0.9 * random(n, 1, 1)
        disc = torch.hypot(u, v / slim) < size
        box = (u.abs() < size) & (v.abs() < size * slim)
        inside = torch.where(random(n, 1, 1) < 0.5, disc, box)
        fill = random(n, 1, 1) + (u / size) * 0.4 * (random(n, 1, 1) - 0.5)
        rough = 0.25 * random(n, 1, 1) * (random(n, 1, 1) < 0.6)
        picture = torch.where(inside, fill + rough * texture.roll(37 * (k + 1), 1 + k % 2), picture)
    picture = picture.clamp(0.0, 1.0) ** (1.0 + 1.2 * random(n, 1, 1))
    soft = functional.avg_pool2d(picture[:, None], 3, 1, 1)
    return torch.where(random(n, 1, 1, 1) < 0.5, soft, picture[:, None])


@dataclass
class World:
    """Textured background with moving bodies in front, all flat. Canvases have twice the pixels of the image."""

    background: Tensor
    """Luminance, shape (n, 1, S, S)."""
    textures: list[Tensor]
    """Luminance of each body, shape (n, 1, S, S)."""
    shapes: list[Tensor]
    """Half width, half height [px], whether round, whether present, of each body, shape (n, 4)."""
    motions: list[Tensor]
    """Place [px], velocity [px/s], angle [rad] and its rate [rad/s] of each body, shape (n, 6)."""
    drift: Tensor
    """Velocity of the background [px/s], shape (n, 2)."""
    mask: Tensor | None = None
    """Where the last view saw bodies, shape (n, H, W)."""

    def view(self, x: Tensor, y: Tensor, t_s: float) -> Tensor:
        """Return log intensity at places of the scene [px from its middle], shape (H, W) each, at a time."""
        # Canvases have two pixels per pixel, and coordinates from -1 to 1
        scale = 4.0 / self.background.shape[-1]

        def sampled(picture: Tensor, u: Tensor, v: Tensor) -> Tensor:
            where = torch.stack([u * scale, v * scale], -1)
            return functional.grid_sample(
                picture, where, padding_mode="reflection", align_corners=False
            )[:, 0]

        drift = self.drift.view(-1, 2, 1, 1) * t_s
        seen = sampled(self.background, x - drift[:, 0], y - drift[:, 1])
        self.mask = torch.zeros_like(seen)
        for texture, shape, motion in zip(self.textures, self.shapes, self.motions, strict=True):
            px, py, vx, vy, angle, rate = (motion[:, k].view(-1, 1, 1) for k in range(6))
            u0, v0, turn = x - px - vx * t_s, y - py - vy * t_s, angle + rate * t_s
            u, v = u0 * turn.cos() + v0 * turn.sin(), v0 * turn.cos() - u0 * turn.sin()
            half, tall, is_round, present = (shape[:, k].view(-1, 1, 1) for k in range(4))
            disc = (1.0 - torch.hypot(u / half, v / tall)) * torch.minimum(half, tall)
            box = torch.minimum(half - u.abs(), tall - v.abs())
            cover = (torch.where(is_round > 0.5, disc, box) + 0.5).clamp(0.0, 1.0) * present
            seen = seen + cover * (sampled(texture, u, v) - seen)
            self.mask = torch.maximum(self.mask, cover)
        return torch.log(seen + WHITE)


def world(
    pictures: Tensor, side: tuple[int, int], still: Tensor, px_per_s: float, rng: torch.Generator
) -> World:
    """Return a world that moves by up to ``px_per_s``, at rest where ``still``. Bodies have each other's pictures."""
    n, device = len(pictures), pictures.device

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, device=device)

    moving = 1.0 - still.float()
    textures, shapes, motions = [], [], []
    for k in range(3):
        size = (0.06 + 0.2 * random(n, 2)) * min(side)
        present = moving * (random(n) < (1.0, 0.6, 0.3)[k])
        shapes.append(torch.cat([size, (random(n, 1) < 0.5).float(), present[:, None]], 1))
        place = (random(n, 2) - 0.5) * torch.tensor([side[1], side[0]], device=device)
        speed, way = px_per_s * random(n, 1), math.tau * random(n, 1)
        rest = torch.cat([math.tau * random(n, 1), 8.0 * (random(n, 1) - 0.5)], 1)
        motions.append(torch.cat([place, speed * way.cos(), speed * way.sin(), rest], 1))
        textures.append(pictures.roll(k + 1, 0))
    drift = 0.2 * px_per_s * (random(n, 2) - 0.5) * (moving * (random(n) < 0.3))[:, None]
    return World(pictures, textures, shapes, motions, drift)


def recorded(
    scene: World, model: CircleModel, encoder: Encoder, sensor: EventSensor, times: np.ndarray
) -> Iterator[tuple[DeviceEvents, Windows]]:
    """Yield what the sensors see at each time [us]."""
    camera, device = model.camera, scene.background.device
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([columns.ravel(), rows.ravel()], 1).astype(np.float64)
    for t in times:
        seen = np.asarray(
            model.compensate_points(pixels, np.full(len(pixels), encoder.angles_at([t])[0]))
        )
        x, y = torch.tensor((seen - [camera.cx, camera.cy]).T, dtype=torch.float32, device=device)
        size = camera.height, camera.width
        yield sensor.step(scene.view(x.view(size), y.view(size), t * 1e-6).contiguous(), int(t))


def truth(scene: World, camera: Camera, t_us: float) -> Tensor:
    """Return log intensity without the prism, shape (n, H, W)."""
    device = scene.background.device
    x, y = (
        torch.arange(camera.width, device=device) - camera.cx,
        torch.arange(camera.height, device=device) - camera.cy,
    )
    return scene.view(
        x[None, :].expand(camera.height, -1), y[:, None].expand(-1, camera.width), t_us * 1e-6
    )


# Training.


def random_sensor(rng: np.random.Generator) -> tuple[SensorModel, float]:
    """Return a sensor and its threshold."""
    contrast = float(np.exp(rng.uniform(math.log(0.12), math.log(0.5))))
    return SensorModel(
        contrast_on=contrast, contrast_off=contrast * float(rng.uniform(0.95, 1.05)),
        shot_noise_hz=float(np.exp(rng.uniform(math.log(0.05), math.log(40.0)))),
        refractory_us=float(rng.uniform(0.0, 300.0)),
    ), contrast  # fmt: skip


def samples(cameras: int, side: int, seed: int, device: str) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield inputs and truth of two successive quarter turns of random worlds, half of them at rest."""
    rng, generator = np.random.default_rng([seed, 5]), torch.Generator(device).manual_seed(seed)
    camera = Camera(side, side, 300.0, 300.0, 0.5 * (side - 1), 0.5 * (side - 1))
    radius, quarter = (
        float(rng.uniform(1.5, 6.0)),
        int(rng.uniform(10_000, 30_000)) // (BINS * STEPS),
    )
    quarter *= BINS * STEPS
    begin = math.tau * float(rng.random())
    model = CircleModel(camera, radius / camera.fx, begin)
    last = 4 * quarter
    encoder = Encoder.constant_speed(15e6 / quarter, 0, last, direction=int(rng.choice([-1, 1])))
    sensor_model, contrast = random_sensor(rng)
    sensor = EventSensor(
        cameras, side, side, sensor_model, seed=seed * cameras % (1 << 30), device=device
    )
    still = torch.arange(cameras, device=device) % 2 == 0
    scene = world(
        leaves(cameras, 2 * (side + 32), generator, device),
        (side, side),
        still,
        12e6 / quarter,
        generator,
    )
    step = quarter // (BINS * STEPS)
    times = np.arange(0, 3 * quarter + 1, step)
    seen = recorded(scene, model, encoder, sensor, times)
    for _ in range(BINS * STEPS + 1):  # references settle for a quarter turn
        next(seen)
    for k in (1, 2):
        parts = torch.zeros(cameras, BINS, 2, side, side, device=device)
        for b in range(BINS):
            for _ in range(STEPS):
                events, found = next(seen)
                counts = polarity_histogram(
                    events, side, side, windows=found, model=model, encoder=encoder
                )
                parts[:, b] += torch.from_dlpack(counts)
        ends = np.arange(BINS + 1) * quarter // BINS + k * quarter
        target = truth(scene, camera, (k + 0.5) * quarter) / contrast
        yield (
            sums_of_parts(parts, chords_of(model, encoder, ends)),
            target - target.mean((1, 2), keepdim=True),
        )


def similarity(found: Tensor, true: Tensor) -> Tensor:
    """Return SSIM with 7 × 7 windows relative to each picture's range, shape (n, H - 6, W - 6)."""
    span = true.flatten(1).quantile(0.995, 1) - true.flatten(1).quantile(0.005, 1)
    a, b = ((z / span.clamp_min(1.0).view(-1, 1, 1))[:, None] for z in (found, true))

    def mean(z: Tensor) -> Tensor:
        return functional.avg_pool2d(z, 7, 1)

    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    return (
        ((2 * ma * mb + 1e-4) * (2 * cov + 9e-4)) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    )[:, 0]


def loss(found: Tensor, true: Tensor) -> Tensor:
    """Return the error of pictures: of values, of differences of neighbours at two distances, and of SSIM."""
    error = found - true
    out = 0.2 * error.abs().mean()
    for step in (1, 4):
        out = out + 0.5 * ((error[:, step:] - error[:, :-step]).abs().mean()
                           + (error[:, :, step:] - error[:, :, :-step]).abs().mean())  # fmt: skip
    return out + 2.0 * (1.0 - similarity(found, true).mean())


def train(options: argparse.Namespace) -> None:
    """Train for a time, and write the network as a TorchScript file."""
    torch.manual_seed(0)
    device = options.device
    network = UNet().to(device)
    if options.start:
        network.load_state_dict(torch.jit.load(options.start, map_location=device).state_dict())
    print(sum(p.numel() for p in network.parameters()), "parameters", flush=True)
    optimizer = torch.optim.AdamW(network.parameters(), options.rate, weight_decay=1e-4)
    room = options.pool
    pool = torch.zeros(room, INPUTS, options.side, options.side, dtype=torch.float16, device=device)
    goal = torch.zeros(room, options.side, options.side, device=device)
    filled, seed, steps = 0, options.first, 0
    began, said = time.perf_counter(), 0.0
    history: list[float] = []
    while (elapsed := time.perf_counter() - began) < options.seconds:
        for given, target in samples(options.cameras, options.side, seed, device):
            at = torch.arange(filled, filled + len(given), device=device) % room
            pool[at], goal[at] = given.half(), target
            filled += len(given)
        seed += 1
        for _ in range(options.repeats):
            rate = (
                options.rate
                * min(1.0, steps / 200)
                * 0.5
                * (1.0 + math.cos(math.pi * min(1.0, elapsed / options.seconds)))
            )
            for group in optimizer.param_groups:
                group["lr"] = rate
            pick = torch.randint(0, min(filled, room), (options.batch,), device=device)
            given, target = pool[pick].float(), goal[pick]
            with torch.autocast(torch.device(device).type, torch.bfloat16, enabled=device != "cpu"):
                found = network(given)[:, 0].float()
            error = loss(found - found.mean((1, 2), keepdim=True), target)
            optimizer.zero_grad()
            error.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            history.append(error.detach())
            steps += 1
        if elapsed - said > 20.0:
            said = elapsed
            print(
                f"{elapsed:.0f} s, {filled} samples, {steps} steps, {torch.stack(history[-100:]).mean():.4f}",
                flush=True,
            )
    # A trace holds the operators that it used only, so that other versions of PyTorch read it. It also holds whether
    # they may round to 10 bits on CUDA (TF32), by which pictures would differ with the number of windows at a time.
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        torch.jit.trace(network.cpu().eval(), torch.zeros(1, INPUTS, 64, 96)).save(options.out)
    print(f"{filled} samples, {steps} steps", flush=True)


# Comparison with the solver.

TURN_US = 83_328
"""Turns of 83.3 ms, a multiple of the parts and of the images that are drawn."""
START_US = TURN_US
CASES = ((0.25, 0.0), (0.25, 10.0), (0.25, 30.0), (0.1, 0.0), (0.5, 0.0))
"""Thresholds and rates of noise [1/s]."""


def on_device(given: Recording, device: str) -> Recording:
    """Return a recording whose events are on the device."""
    host = given.events[:]
    events = DeviceEvents.from_arrays(host.x, host.y, host.t, host.p, device=device)
    return replace(given, events=DeviceMemoryEvents(events, *given.events.size))


def by_network(network: Network, recording: Recording, model: Model) -> Tensor:
    """Return the network's log intensity of the quarter turn from :data:`START_US`, shape (H, W)."""
    assert isinstance(recording.events, DeviceMemoryEvents)
    end = START_US + TURN_US // 4
    events, size = recording.events.between_on_device(START_US, end), recording.events.size
    out = network(
        events, *size, t_start=START_US, t_end=end, model=model, encoder=recording.encoder
    )
    return torch.from_dlpack(out)[0]


def by_solver(recording: Recording, model: Model, device: str) -> Tensor:
    """Return the solver's log intensity of the same events, shape (H, W)."""
    found = Reconstruction(recording, model=model, device=device).window(START_US, TURN_US // 4)
    return (
        torch.from_dlpack(found.log)
        if isinstance(found.log, wp.array)
        else torch.from_numpy(found.log)
    )


def timed(work: Callable[[], Tensor], repeats: int = 5) -> tuple[np.ndarray, float]:
    """Return the result on the host, and the least time of a call [s]."""
    seconds = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        found = work().cpu()
        seconds.append(time.perf_counter() - began)
    return found.double().numpy(), min(seconds[1:])


def judged(log: np.ndarray, true: np.ndarray, areas: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the mean SSIM in areas after fitting gain and offset, and the correlation."""
    quality = picture_quality(log, true)
    fitted = quality.gain * log + quality.offset
    span = float(np.ptp(np.percentile(true, TRUTH_PERCENTILES)))
    _, similar = structural_similarity(true, fitted, data_range=span, full=True)
    return {name: float(similar[where].mean()) for name, where in areas.items()} | {
        "correlation": quality.correlation
    }


def compared(
    network: Network,
    recording: Recording,
    model: Model,
    true: np.ndarray,
    moving: np.ndarray | None = None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what both methods measure, and their pictures."""
    assert isinstance(recording.events, DeviceMemoryEvents)
    events = recording.events.between_on_device(START_US, START_US + TURN_US // 4)
    device = str(events.t.device)
    areas = {"all": np.ones(true.shape, bool), "textured": textured(true)}
    if moving is not None:
        areas["moving"] = moving
    row: dict[str, Any] = {"events": len(events)}
    pictures = {"truth": true}
    for name, work in (("network", lambda: by_network(network, recording, model)),
                       ("solver", lambda: by_solver(recording, model, device))):  # fmt: skip
        pictures[name], seconds = timed(work)
        row[name] = judged(pictures[name], true, areas) | {"seconds": seconds}
    cut = windows(recording.events[:], encoder=recording.encoder, turns=0.25)

    def video() -> Tensor:
        found = network.over(recording, cut, model=model, encoder=recording.encoder)
        return torch.stack([torch.from_dlpack(picture) for picture in found])

    _, seconds = timed(video)
    row["network"]["seconds_in_a_video"] = seconds / len(cut)
    return row, pictures


def at_rest(
    picture: Path, contrast: float, noise_hz: float, device: str
) -> tuple[Recording, Model, np.ndarray]:
    """Return a recording of a picture at rest, by the simulator and the exact model, and its true log intensity."""
    sensor = SensorModel(contrast_on=contrast, contrast_off=contrast, shot_noise_hz=noise_hz)
    motion = PrismMotion(60e6 / TURN_US, PHASE)
    scene = Scene.from_picture(picture)
    through = Simulation(
        scene, CAMERA, PRISM, 1.3 * TURN_US * 1e-6, motion, sensor=sensor, device=device
    )
    return (
        on_device(through.run(), device),
        ExactModel(CAMERA, PRISM, PHASE),
        through.log_view().astype(np.float64),
    )


def in_motion(
    pictures: Tensor, seed: int, device: str
) -> tuple[Recording, Model, np.ndarray, np.ndarray]:
    """Return a recording of bodies that move over a picture, and where bodies are in the middle of the quarter turn."""
    model = CircleModel(CAMERA, PRISM.deflection, PHASE)
    encoder = Encoder.constant_speed(60e6 / TURN_US, 0, 2 * TURN_US)
    generator = torch.Generator(device).manual_seed(seed)
    order = torch.arange(len(pictures), device=device).roll(seed)[:4]
    still = torch.zeros(len(order), dtype=torch.bool, device=device)
    both = world(pictures[order], (CAMERA.height, CAMERA.width), still, 500.0, generator)
    one = World(both.background[:1], [z[:1] for z in both.textures], [z[:1] for z in both.shapes],
                [z[:1] for z in both.motions], both.drift[:1])  # fmt: skip
    for motion in one.motions:  # bodies are near the middle of the image during the quarter turn
        motion[:, :2] = 0.6 * motion[:, :2] - motion[:, 2:4] * 1.125e-6 * TURN_US
    sensor = EventSensor(
        1, CAMERA.height, CAMERA.width, SensorModel(shot_noise_hz=1.0), seed=seed, device=device
    )
    times = np.arange(0, TURN_US * 5 // 4 + 1, TURN_US // 96)
    seen = [events.to_host() for events, _ in recorded(one, model, encoder, sensor, times)]
    columns = [
        np.concatenate([getattr(part, name) for part in seen]) for name in ("x", "y", "t", "p")
    ]
    events = DeviceEvents.from_arrays(*columns, device=device)
    recording = Recording(DeviceMemoryEvents(events, CAMERA.width, CAMERA.height), encoder=encoder)
    true = truth(one, CAMERA, 1.125 * TURN_US)[0].double().cpu().numpy()
    assert one.mask is not None
    near = ndimage.binary_dilation(one.mask[0].cpu().numpy() > 0.5, iterations=5)
    return recording, model, true, near


def evaluate(options: argparse.Namespace) -> None:
    """Compare the network with the solver, and write the rows."""
    device, rows, shown = options.device, [], []
    network = Network.quarter_turn(device=device)
    files = sorted(p for p in options.pictures.iterdir() if p.suffix in (".jpg", ".png"))
    for path in files:
        for contrast, noise_hz in CASES:
            recording, model, true = at_rest(path, contrast, noise_hz, device)
            row, pictures = compared(network, recording, model, true)
            rows.append({"picture": path.name, "contrast": contrast, "noise_hz": noise_hz} | row)
            print(json.dumps(rows[-1]), flush=True)
            if (contrast, noise_hz) == (0.25, 10.0):
                shown.append(pictures)
    canvases = torch.cat([canvas(path) for path in files]).to(device)
    for seed in range(options.seeds):
        recording, model, true, near = in_motion(canvases, seed, device)
        row, pictures = compared(network, recording, model, true, near)
        rows.append({"seed": seed} | row)
        print(json.dumps(rows[-1]), flush=True)
        shown += [pictures] if seed < 4 else []
    options.out.write_text(
        json.dumps({"device": str(wp.get_device(device).name), "rows": rows}, indent=1) + "\n"
    )
    if options.figure:
        draw(shown, options.figure)


def canvas(path: Path) -> Tensor:
    """Return the luminance of a picture file on a canvas of twice the camera's size, shape (1, 1, S, S)."""
    from PIL import Image

    side = 2 * (CAMERA.width + 32)
    picture = np.asarray(Image.open(path).convert("L").resize((side, side)), np.float32) / 255.0
    return torch.from_numpy(picture**2.2)[None, None]


def draw(shown: list[dict[str, np.ndarray]], path: Path) -> None:
    """Draw the truth and the pictures of both methods, one row each."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 2.3 * len(shown)), layout="compressed")
    axes = figure.subplots(len(shown), 3, squeeze=False)
    for line, pictures in zip(axes, shown, strict=True):
        for ax, (name, picture) in zip(line, pictures.items(), strict=True):
            low, high = np.percentile(picture, [0.5, 99.5])
            ax.imshow(picture, cmap="gray", vmin=low, vmax=high)
            ax.set(xticks=[], yticks=[])
            ax.set_title(name, fontsize=8)
    figure.savefig(path, dpi=90)


def main() -> None:
    """Train or evaluate."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, required=True)
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("train")
    training.add_argument("--seconds", type=float, default=400.0)
    training.add_argument("--start", type=Path, help="network to go on from")
    training.add_argument("--first", type=int, default=0, help="seed of the first worlds")
    training.add_argument("--rate", type=float, default=2e-3, help="learning rate")
    training.add_argument("--cameras", type=int, default=256)
    training.add_argument("--side", type=int, default=128)
    training.add_argument("--pool", type=int, default=16_384)
    training.add_argument("--batch", type=int, default=64)
    training.add_argument("--repeats", type=int, default=16)
    comparing = commands.add_parser("evaluate")
    comparing.add_argument("pictures", type=Path)
    comparing.add_argument("--figure", type=Path)
    comparing.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    train(options) if options.command == "train" else evaluate(options)


if __name__ == "__main__":
    main()
