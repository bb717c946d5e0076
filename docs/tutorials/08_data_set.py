"""
From folders of pictures to a classifier
========================================

Data sets such as N-Caltech101 have one folder of pictures for each class.
:func:`amiwarp.make_dataset` turns such folders into recordings of a camera behind a
rotating prism, with labels, splits and checksums. This tutorial draws its own
pictures, makes the data set, and trains a small classifier on its events.

Folders of pictures
-------------------

Each picture shows one shape: a disc, a square or a cross, of random size, place and
brightness. The folder's name is the class.
"""

import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from scipy.optimize import minimize
from scipy.special import log_softmax

import amiwarp

rng = np.random.default_rng(1)
folder = Path(tempfile.mkdtemp())
rows, columns = np.mgrid[:72, :96]


def draw(shape):
    """Draw one shape on a grey background."""
    size = rng.uniform(11.0, 16.0)
    x, y = columns - rng.uniform(36, 60), rows - rng.uniform(28, 44)
    inside = {
        "disc": np.hypot(x, y) < size,
        "square": np.maximum(abs(x), abs(y)) < 0.886 * size,
        "cross": (np.minimum(abs(x), abs(y)) < 0.35 * size)
        & (np.maximum(abs(x), abs(y)) < size),
    }[shape]
    return np.where(inside, rng.integers(140, 250), rng.integers(30, 90))


CLASSES = ("cross", "disc", "square")
for shape in CLASSES:
    (folder / "pictures" / shape).mkdir(parents=True)
    for k in range(24):
        picture = Image.fromarray(draw(shape).astype(np.uint8))
        picture.save(folder / "pictures" / shape / f"{k:02}.png")

# %%
# The specification
# -----------------
#
# Each combination of picture, prism, speed, sensor and seed becomes one recording.
# A picture belongs to one split, so that no test recording shows a picture of the
# training set. The label ``class`` is the name of the folder.

specification = folder / "shapes.toml"
specification.write_text("""
format = "amiwarp-dataset-specification"
version = 1
duration_s = 0.04
prisms = [{apex_deg = 1.5}]
speeds_rpm = [1500.0]
sensors = ["davis346"]
splits = {train = 0.7, test = 0.3}
camera = {size = [96, 72], fov_deg = 40.0}

[[sources]]
pictures = "pictures/*/*.png"
label_from_folder = "class"
licence = "CC0-1.0"
""")

plan = amiwarp.plan_dataset(specification, folder / "shapes", workers=1)
print(f"{plan.missing} recordings, about {plan.size_bytes / 1e6:.2g} MB")

# %%
# The data set
# ------------
#
# On the command line this is ``amiwarp dataset shapes.toml shapes``. One worker is
# a part of this process; without ``workers`` there is one process for each core, or
# up to four for each GPU. A second call would find everything in place.

done = amiwarp.make_dataset(specification, folder / "shapes", workers=1)
print(f"{done.made} recordings, {done.events:,} events")

manifest = json.loads((folder / "shapes" / "manifest.json").read_text())
for name in ("file", "split", "labels", "events", "rpm", "licence"):
    print(f"{name:8}", manifest["items"][0][name])

# %%
# Features
# --------
#
# The prism moves every edge on a circle. The optical model moves the events back,
# and their image (:func:`amiwarp.iwe`) shows the edges sharply. The magnitudes of
# its low spatial frequencies do not depend on where the shape lies.


def image_of(item):
    """Return the compensated image of a recording."""
    recording = amiwarp.open_recording(folder / "shapes" / item["file"])
    events = recording.events[:]
    model = amiwarp.ExactModel.from_prism(recording.camera, recording.prism)
    size = recording.events.size
    return amiwarp.iwe(events, *size, model=model, encoder=recording.encoder)


def features_of(image):
    """Return the magnitudes of the low spatial frequencies of an image."""
    spectrum = np.abs(np.fft.fft2(np.sqrt(image)))
    low = np.concatenate([spectrum[:12, :12], spectrum[-12:, :12]])
    return np.log(low.ravel() / spectrum[0, 0] + 1e-3)


images = [image_of(item) for item in manifest["items"]]
features = np.stack([features_of(image) for image in images])
names = [item["labels"]["class"] for item in manifest["items"]]
target = np.array([CLASSES.index(name) for name in names])
train = np.array([item["split"] == "train" for item in manifest["items"]])

figure, axes = plt.subplots(1, 3, figsize=(8.0, 2.2))
for number, ax in enumerate(axes):
    ax.imshow(images[int(np.argmax(target == number))])
    ax.set(title=CLASSES[number], xticks=[], yticks=[])
plt.show()

# %%
# A classifier
# ------------
#
# Multinomial logistic regression with a quadratic penalty, fitted to the training
# recordings and judged on the others.

mean, spread = features[train].mean(axis=0), features[train].std(axis=0)
x = np.column_stack([(features - mean) / spread, np.ones(len(features))])


def loss(flat):
    """Return the penalised mean negative log-likelihood, and its gradient."""
    weights = flat.reshape(x.shape[1], len(CLASSES))
    log_p = log_softmax(x[train] @ weights, axis=1)
    n = train.sum()
    wanted = np.eye(len(CLASSES))[target[train]]
    gradient = x[train].T @ (np.exp(log_p) - wanted) / n + 0.02 * weights
    value = -np.sum(wanted * log_p) / n + 0.01 * np.sum(weights**2)
    return value, gradient.ravel()


start = np.zeros(x.shape[1] * len(CLASSES))
found = minimize(loss, start, jac=True, method="L-BFGS-B").x
guess = np.argmax(x @ found.reshape(x.shape[1], -1), axis=1)
accuracy = float(np.mean(guess[~train] == target[~train]))
chance = float(np.bincount(target[~train]).max() / np.sum(~train))
print(f"{train.sum()} recordings to train, {np.sum(~train)} to test")
print(f"accuracy {accuracy:.0%}, largest class {chance:.0%}")
