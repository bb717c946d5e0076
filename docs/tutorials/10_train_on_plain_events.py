"""
Train a network on the events of a plain camera
===============================================

No prism is needed to train on simulated events. This tutorial makes a data set of
an ordinary event camera that turns in one of six ways, makes voxel grids of the
events, and trains a small network of PyTorch to tell how the camera moves. Then it
trains the same network on counts of events, which lack the order in time. It needs
``pip install 'amiwarp[dataset,torch]'``.

A data set without a prism
--------------------------

The pictures are random bright and dark squares. There are as many for each of six
motions: the camera turns to the left or right, up or down, or rolls in either
direction.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image

import amiwarp

TURNS = {
    "left": [0.0, -60.0, 0.0],  # deg/s about the camera's x, y and z axes
    "right": [0.0, 60.0, 0.0],
    "up": [60.0, 0.0, 0.0],
    "down": [-60.0, 0.0, 0.0],
    "roll-left": [0.0, 0.0, -90.0],
    "roll-right": [0.0, 0.0, 90.0],
}
CLASSES = tuple(TURNS)

rng = np.random.default_rng(3)
folder = Path(tempfile.mkdtemp())
for name in CLASSES:
    (folder / "pictures" / name).mkdir(parents=True)
    for k in range(30):
        picture = np.full((96, 96), 110, np.uint8)
        for _ in range(14):
            row, column, size = rng.integers([0, 0, 8], [90, 90, 30])
            square = np.s_[row : row + size, column : column + size]
            picture[square] = rng.integers(20, 250)
        Image.fromarray(picture).save(folder / "pictures" / name / f"{k:02}.png")

# %%
# ``no_prism = true`` makes recordings of an ordinary event camera. A still camera
# in front of a still picture would see only noise, so ``rotate_deg_s`` turns it.
# ``stratify`` divides the pictures of each class in the same way, so that each
# split has all classes.

specification = folder / "turns.toml"
specification.write_text(
    """
format = "amiwarp-dataset-specification"
version = 1
duration_s = 0.1
no_prism = true
sensors = ["davis346"]
splits = {train = 0.7, test = 0.3}
stratify = "turn"
camera = {size = [48, 48], fov_deg = 45.0}
"""
    + "".join(
        f"""
[[sources]]
pictures = "pictures/{name}/*.png"
rotate_deg_s = {speed}
labels = {{turn = "{name}"}}
licence = "CC0-1.0"
"""
        for name, speed in TURNS.items()
    )
)
done = amiwarp.make_dataset(specification, folder / "turns", workers=1)
print(f"{done.made} recordings, {done.events:,} events")

# %%
# From files to tensors
# ---------------------
#
# :class:`amiwarp.RecordedDataset` is a data set for the ``DataLoader`` of PyTorch.
# :func:`amiwarp.collate` joins the events of a batch and copies them to the device,
# and :func:`amiwarp.voxel_grid` makes all tensors of the batch in one call. This
# data set is small, so its tensors are made once and kept.
# :doc:`examples/train_from_files.py </reference/files/train_from_files>` reads the
# files anew in every epoch, in worker processes.

device = "cuda:0" if torch.cuda.is_available() else "cpu"
SIDE, BINS = 48, 5


def tensors(split):
    """Return voxel grids, counts of events, and classes of a split."""
    dataset = amiwarp.RecordedDataset(folder / "turns", split=split)
    loader = torch.utils.data.DataLoader(dataset, batch_size=32, collate_fn=list)
    grids, counts, classes = [], [], []
    for batch in loader:
        blocks = [found for found, _ in batch]
        events, windows = amiwarp.collate(blocks, device=device)
        made = amiwarp.voxel_grid(
            events, SIDE, SIDE, BINS, windows=windows, normalize=True
        )
        grids.append(torch.from_dlpack(made))
        made = amiwarp.event_count(events, SIDE, SIDE, windows=windows)
        counts.append(torch.from_dlpack(made)[:, None].float())
        classes += [CLASSES.index(labels["turn"]) for _, labels in batch]
    counts = torch.cat(counts)
    counts = counts / counts.std(dim=(1, 2, 3), keepdim=True)
    return torch.cat(grids), counts, torch.tensor(classes, device=device)


grids, counts, classes = tensors("train")
test_grids, test_counts, test_classes = tensors("test")
print("to train", tuple(grids.shape), "to test", tuple(test_grids.shape))

# %%
# A voxel grid shares the polarity of each event between time bins. Edges move from
# bin to bin, in the direction opposite to the camera's turn.

figure, panels = plt.subplots(3, BINS + 1, figsize=(8.0, 4.2))
for row, number in zip(panels, (0, 2, 4), strict=True):
    at = int((classes == number).nonzero()[0])
    for k, ax in enumerate(row[:BINS]):
        ax.imshow(grids[at, k].cpu(), vmin=-2, vmax=2)
        ax.set_title(f"bin {k + 1}" if number == 0 else "", fontsize=9)
    row[-1].imshow(counts[at, 0].cpu())
    row[-1].set_title("counts" if number == 0 else "", fontsize=9)
    row[0].set_ylabel(CLASSES[number])
for ax in panels.flat:
    ax.set(xticks=[], yticks=[])
plt.show()

# %%
# A network
# ---------
#
# Three layers of convolutions and one linear layer. Such a small network is fastest
# on one core.

torch.set_num_threads(1)


def train(inputs, *, epochs=30, batch_size=16):
    """Return a network trained on tensors of all recordings, and its losses."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.Conv2d(inputs.shape[1], 16, 5, stride=2),
        torch.nn.ReLU(),
        torch.nn.Conv2d(16, 24, 5, stride=2),
        torch.nn.ReLU(),
        torch.nn.Conv2d(24, 24, 3),
        torch.nn.ReLU(),
        torch.nn.AdaptiveAvgPool2d(2),
        torch.nn.Flatten(),
        torch.nn.Linear(96, len(CLASSES)),
    ).to(device)
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    losses = []
    for _ in range(epochs):
        order = torch.randperm(len(inputs))
        sum_of_losses = 0.0
        for chosen in order.split(batch_size):
            found = network(inputs[chosen])
            loss = torch.nn.functional.cross_entropy(found, classes[chosen])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            sum_of_losses += loss.item() * len(chosen)
        losses.append(sum_of_losses / len(inputs))
    return network, losses


def confusion(network, inputs):
    """Return how often each class was taken for each other one."""
    with torch.no_grad():
        guess = network(inputs).argmax(1)
    table = np.zeros((len(CLASSES), len(CLASSES)), int)
    np.add.at(table, (test_classes.cpu().numpy(), guess.cpu().numpy()), 1)
    return table


results = {}
for name, inputs, test_inputs in (
    ("voxel grids", grids, test_grids),
    ("counts", counts, test_counts),
):
    network, losses = train(inputs)
    table = confusion(network, test_inputs)
    results[name] = losses, table
    print(f"{name:11} {np.trace(table) / table.sum():.0%} of {table.sum()} right")

# %%
# Counts show the axis of the turn at best: edges across the motion make more events
# than those along it. They do not show the direction: an edge that moves left
# passes the same pixels as one that moves to the right. So the network often
# confuses a turn with the opposite one.

figure, axes = plt.subplots(1, 3, figsize=(8.0, 3.0), width_ratios=(1.2, 1, 1))
for ax, (name, (losses, table)) in zip(axes[1:], results.items(), strict=True):
    axes[0].semilogy(np.arange(1, len(losses) + 1), losses, label=name)
    ax.imshow(table, cmap="Blues")
    for (i, j), value in np.ndenumerate(table):
        colour = "white" if value > 0.6 * table.max() else "black"
        if value:
            ax.text(j, i, value, ha="center", va="center", color=colour, fontsize=8)
    ax.set_xticks(range(len(CLASSES)), CLASSES, rotation=90, fontsize=8)
    ax.set_yticks(range(len(CLASSES)), CLASSES, fontsize=8)
    ax.set(title=f"{name}: found", ylabel="true")
axes[0].set(xlabel="epoch", ylabel="cross-entropy in training")
axes[0].legend()
plt.show()

found, other = (np.trace(table) / table.sum() for _, table in results.values())
assert found > 0.85 > other
