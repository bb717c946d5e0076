"""Train a network on the events of many cameras at once: images of another program go in, tensors come out.

Each camera sees a grating that moves to the left, to the right, up or down, drawn by PyTorch. A robot simulator's
renderer may take its place: images, events and tensors stay on the device. Needs ``pip install 'amiwarp[torch]'``.
"""

import math

import torch

import amiwarp

CAMERAS, SIDE, STEPS, STEP_US, DIRECTIONS, BATCHES = 32, 32, 4, 2_000, 4, 28
DEVICE = "cuda:0" if torch.cuda.is_available() else "cpu"
SENSOR = amiwarp.EventSensor(
    CAMERAS, SIDE, SIDE, amiwarp.SensorModel.preset("davis346"), device=DEVICE
)

torch.manual_seed(0)
y, x = torch.meshgrid(*2 * [torch.arange(SIDE, device=DEVICE, dtype=torch.float32)], indexing="ij")


def batch() -> tuple[torch.Tensor, torch.Tensor]:
    """Return the voxel grids of new gratings, one for each camera, and the directions in which they move."""
    labels = torch.randint(DIRECTIONS, (CAMERAS,), device=DEVICE)
    angle = (labels * (2.0 * math.pi / DIRECTIONS))[:, None, None]
    length, start, speed = (low + (high - low) * torch.rand(CAMERAS, 1, 1, device=DEVICE)
                            for low, high in ((10.0, 14.0), (0.0, 14.0), (0.4, 0.8)))  # fmt: skip
    grids = []
    SENSOR.reset()
    for k in range(STEPS):
        place = x * torch.cos(angle) + y * torch.sin(angle) + start - speed * k
        luminance = 0.5 + 0.4 * torch.sin(place * (2.0 * math.pi) / length)
        events, windows = SENSOR.step(torch.log(luminance + 0.02), k * STEP_US)
        if k:  # the first images only set the references
            grids.append(
                torch.from_dlpack(amiwarp.voxel_grid(events, SIDE, SIDE, bins=2, windows=windows))
            )
    return torch.cat(grids, dim=1), labels


network = torch.nn.Sequential(
    torch.nn.Conv2d(2 * (STEPS - 1), 16, 7, stride=2), torch.nn.ReLU(), torch.nn.Conv2d(16, 16, 5), torch.nn.ReLU(),
    torch.nn.AdaptiveAvgPool2d(1), torch.nn.Flatten(), torch.nn.Linear(16, DIRECTIONS),
).to(DEVICE)  # fmt: skip
optimiser = torch.optim.Adam(network.parameters(), 5e-3)
for _ in range(BATCHES):
    grids, labels = batch()
    loss = torch.nn.functional.cross_entropy(network(grids), labels)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()

grids, labels = batch()  # gratings that the network has not seen
correct = (network(grids).argmax(1) == labels).float().mean().item()
print(
    f"{correct:.0%} of {CAMERAS} new gratings right on {DEVICE}; guessing gives {1 / DIRECTIONS:.0%}"
)
assert correct > 2 / DIRECTIONS, "the network has learnt nothing"
