"""Train a small network on events that are simulated where it trains: on a GPU they never touch the host's memory.

Each sample is a new grating behind a turning prism. A network of PyTorch tells its orientation from the image of the
compensated events. Needs ``pip install 'amiwarp[torch]'``.
"""

import math

import numpy as np
import torch

import amiwarp

SIDE, ORIENTATIONS, BATCH, BATCHES, PASSES = 32, 4, 16, 10, 6
DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"
CAMERA, PRISM = (
    amiwarp.Camera.from_fov(SIDE, SIDE, math.radians(20)),
    amiwarp.Prism(math.radians(1.5)),
)
MODEL = amiwarp.ExactModel(CAMERA, PRISM)


def sample(label: int, seed: int) -> torch.Tensor:
    """Return the image of the compensated events (OFF, ON) of a random grating, on the device."""
    rng = np.random.default_rng(seed)
    angle = (label + rng.uniform(-0.2, 0.2)) * math.pi / ORIENTATIONS
    y, x = np.mgrid[:64, :64]
    wave = np.sin(
        (x * math.cos(angle) + y * math.sin(angle)) * rng.uniform(0.3, 0.5)
        + rng.uniform(0, 2 * math.pi)
    )
    picture = (0.5 + rng.uniform(0.2, 0.45) * wave).astype(np.float32)
    recording = amiwarp.simulate(
        picture,
        CAMERA,
        PRISM,
        duration_s=0.02,
        motion=3000.0,
        seed=seed,
        device=DEVICE,
        on_device=True,
    )
    events = recording.events.slice_on_device(0, len(recording.events))
    image = amiwarp.iwe(
        events, SIDE, SIDE, model=MODEL, encoder=recording.encoder, per_polarity=True
    )
    return torch.from_dlpack(image)


def batch(first_seed: int, count: int = BATCH) -> tuple[torch.Tensor, torch.Tensor]:
    """Return images of new gratings, and their orientations."""
    labels = [seed % ORIENTATIONS for seed in range(first_seed, first_seed + count)]
    images = torch.stack([sample(label, first_seed + k) for k, label in enumerate(labels)])
    return images / images.mean(), torch.tensor(labels, device=DEVICE)


torch.manual_seed(0)
network = torch.nn.Sequential(
    torch.nn.Conv2d(2, 8, 7, stride=2), torch.nn.ReLU(), torch.nn.Conv2d(8, 16, 5), torch.nn.ReLU(),
    torch.nn.AdaptiveAvgPool2d(2), torch.nn.Flatten(), torch.nn.Linear(64, ORIENTATIONS),
).to(DEVICE)  # fmt: skip
optimiser = torch.optim.Adam(network.parameters(), 3e-3)
for number in range(BATCHES):
    images, labels = batch(number * BATCH)
    for _ in range(PASSES):
        loss = torch.nn.functional.cross_entropy(network(images), labels)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

images, labels = batch(1_000_000, 40)  # gratings that the network has not seen
correct = (network(images).argmax(1) == labels).float().mean().item()
print(f"{correct:.0%} of 40 new gratings right on {DEVICE}; guessing gives {1 / ORIENTATIONS:.0%}")
assert correct > 2 / ORIENTATIONS, "the network has learnt nothing"
