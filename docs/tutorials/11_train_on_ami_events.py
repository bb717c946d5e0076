"""
Train a network on events through a rotating wedge
==================================================

A camera at rest in front of a still scene has no events but noise. Behind a
rotating wedge it sees every edge, but each event is displaced. This tutorial trains
the same network to read letters from the events of a plain camera, from raw events
through a wedge, and from compensated ones. Then it puts another wedge in front of
the camera. It needs ``pip install 'amiwarp[torch]'``.

Letters at rest
---------------

Each scene shows one of six letters, of random place, size and brightness. The wedge
moves the image on a circle with a radius of 4 pixels, once in 83 ms; the strokes of
the letters are 2 to 3 pixels wide. The angle at the start is random, as it is in
the windows of a real recording. The second wedge is weaker and turns in the other
direction.
"""

import math

import matplotlib.pyplot as plt
import numpy as np
import torch

import amiwarp

SIDE, RPM = 48, 720.0
LETTERS = {
    "E": ("111", "100", "110", "100", "111"),
    "F": ("111", "100", "110", "100", "100"),
    "H": ("101", "101", "111", "101", "101"),
    "L": ("100", "100", "100", "100", "111"),
    "T": ("111", "010", "010", "010", "010"),
    "Z": ("111", "001", "010", "100", "111"),
}
CLASSES = tuple(LETTERS)
EACH, TRAIN = 26, 18  # scenes of each letter, and how many of them for training
camera = amiwarp.Camera.from_fov(SIDE, SIDE, math.radians(24.0))
sensor = amiwarp.SensorModel.preset("davis346")
rng = np.random.default_rng(5)


def scene_of(letter):
    """Return a picture of a letter; four of its pixels are one of the camera."""
    width = rng.integers(7, 12)
    strokes = np.array([[int(cell) for cell in row] for row in LETTERS[letter]])
    glyph = np.kron(strokes, np.ones((width, width), int))
    ground, ink = rng.permutation(rng.uniform([0.3, 0.7], [0.45, 1.0]))
    picture = np.full((4 * SIDE, 4 * SIDE), ground, np.float32)
    top, left = (rng.integers(36, 4 * SIDE - 36 - n) for n in glyph.shape)
    part = picture[top : top + glyph.shape[0], left : left + glyph.shape[1]]
    part[glyph > 0] = ink
    return picture


def histogram(events, **optic):
    """Return OFF and ON events at each pixel, divided by their spread."""
    made = amiwarp.polarity_histogram(events, SIDE, SIDE, **optic)
    made = made.astype(np.float32)
    return made / made.std()


def record(scene, apex_deg, rpm, seed):
    """Return the tensors of one turn: of raw and of compensated events."""
    prism = amiwarp.Prism(math.radians(apex_deg))
    phase = rng.uniform(0.0, math.tau)
    recording = amiwarp.simulate(
        scene,
        camera,
        prism,
        duration_s=60.0 / RPM,
        motion=amiwarp.PrismMotion(rpm, phase),
        sensor=sensor,
        seed=seed,
    )
    model = amiwarp.ExactModel.from_prism(camera, prism, phase)
    events = recording.events[:]
    compensated = histogram(events, model=model, encoder=recording.encoder)
    return histogram(events), compensated


KINDS = ("plain camera", "raw", "compensated")
letters = [letter for _ in range(EACH) for letter in CLASSES]
scenes = [scene_of(letter) for letter in letters]
plain = [record(scene, 0.0, 0.0, seed)[0] for seed, scene in enumerate(scenes)]
raw, compensated = zip(
    *(record(scene, 4.0, RPM, seed) for seed, scene in enumerate(scenes)),
    strict=True,
)
inputs = {
    name: torch.from_numpy(np.stack(tensors))
    for name, tensors in zip(KINDS, (plain, raw, compensated), strict=True)
}
classes = torch.arange(len(CLASSES)).repeat(EACH)
first_test = TRAIN * len(CLASSES)

# %%
# The same test scenes behind the second wedge, with an apex angle of 2.5 degrees.

raw, compensated = zip(
    *(
        record(scene, 2.5, -RPM, seed)
        for seed, scene in enumerate(scenes[first_test:], first_test)
    ),
    strict=True,
)
other = {
    "raw": torch.from_numpy(np.stack(raw)),
    "compensated": torch.from_numpy(np.stack(compensated)),
}

# %%
# Six scenes as tensors
# ---------------------
#
# With ``model`` and ``encoder``, :func:`amiwarp.polarity_histogram` moves each
# event back to its position without the wedge, and shares it among the four pixels
# nearest to it. A raw image shows a letter as if drawn with a ring, whose size is
# the size of the wedge's circle.

rows = (
    ("plain camera", inputs["plain camera"][first_test:]),
    ("raw", inputs["raw"][first_test:]),
    ("compensated", inputs["compensated"][first_test:]),
    ("raw,\nother wedge", other["raw"]),
    ("compensated,\nother wedge", other["compensated"]),
)
figure, panels = plt.subplots(len(rows), 6, figsize=(8.0, 6.8))
for k, (name, tensors) in enumerate(rows):
    for number, ax in enumerate(panels[k]):
        ax.imshow(tensors[number].sum(0))
        ax.set(xticks=[], yticks=[], title=CLASSES[number] if k == 0 else "")
    panels[k, 0].set_ylabel(name, fontsize=9)
plt.show()

# %%
# Three networks
# --------------
#
# Each kind of tensor trains the same small network, with random shifts. The scenes
# of the test were not seen in training, and neither was the second wedge.


def layer(before, after):
    """Return a convolution with its normalisation."""
    return (
        torch.nn.Conv2d(before, after, 3, padding=1),
        torch.nn.BatchNorm2d(after),
        torch.nn.ReLU(),
    )


def train(tensors, *, epochs=20, batch_size=18):
    """Return a network trained on the training scenes, and its losses."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        *layer(2, 16),
        torch.nn.MaxPool2d(2),
        *layer(16, 24),
        torch.nn.MaxPool2d(2),
        *layer(24, 32),
        torch.nn.AdaptiveMaxPool2d(1),
        torch.nn.Flatten(),
        torch.nn.Linear(32, len(CLASSES)),
    )
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    losses = []
    for _ in range(epochs):
        sum_of_losses = 0.0
        for chosen in torch.randperm(first_test).split(batch_size):
            shift = torch.randint(-4, 5, (2,)).tolist()
            found = network(tensors[chosen].roll(shift, dims=(2, 3)))
            loss = torch.nn.functional.cross_entropy(found, classes[chosen])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            sum_of_losses += loss.item() * len(chosen)
        losses.append(sum_of_losses / first_test)
    return network.eval(), losses


def confusion(network, tensors):
    """Return how often each letter of the test was taken for each other one."""
    with torch.no_grad():
        guess = network(tensors).argmax(1)
    table = np.zeros((len(CLASSES), len(CLASSES)), int)
    np.add.at(table, (classes[first_test:].numpy(), guess.numpy()), 1)
    return table


torch.set_num_threads(1)  # fastest for such a small network
losses, tables = {}, {}
for name in KINDS:
    network, losses[name] = train(inputs[name])
    tables[name] = confusion(network, inputs[name][first_test:])
    if name in other:
        tables[f"{name}, other wedge"] = confusion(network, other[name])
accuracy = {name: np.trace(table) / table.sum() for name, table in tables.items()}
for name, share in accuracy.items():
    print(f"{name:24} {share:4.0%} of {len(letters) - first_test} letters right")

# %%
# The plain camera guesses. Behind the wedge of the training, the network reads raw
# events about as well as compensated ones: the ring is always the same, so it can
# be learnt. Behind another wedge the ring is another one, and many raw letters are
# misread. Compensated events do not depend on the wedge, so the network goes on to
# read them, if the model of the new wedge is known from a calibration.

figure, axes = plt.subplots(1, 3, figsize=(8.0, 3.0), width_ratios=(1.2, 1, 1))
for name in KINDS:
    axes[0].semilogy(np.arange(1, len(losses[name]) + 1), losses[name], label=name)
axes[0].set(xlabel="epoch", ylabel="cross-entropy in training")
axes[0].legend()
for ax, name in zip(axes[1:], other, strict=True):
    table = tables[f"{name}, other wedge"]
    ax.imshow(table, cmap="Blues", vmin=0, vmax=EACH - TRAIN)
    for (i, j), value in np.ndenumerate(table):
        colour = "white" if value > 0.6 * (EACH - TRAIN) else "black"
        if value:
            ax.text(j, i, value, ha="center", va="center", color=colour, fontsize=8)
    ax.set_xticks(range(len(CLASSES)), CLASSES)
    ax.set_yticks(range(len(CLASSES)), CLASSES)
    ax.set(xlabel="found", ylabel="true")
    ax.set_title(f"{name}, other wedge", fontsize=9)
plt.show()

assert (
    accuracy["plain camera"] < 0.5 < min(accuracy["raw"], accuracy["compensated"])
)
assert accuracy["raw, other wedge"] < accuracy["compensated, other wedge"]
