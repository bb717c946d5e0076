"""Train a network from event files, and measure what the reading of its batches costs.

Worker processes read events and cut windows. While the network trains on a batch on the device, the events of the next
one are copied there and become voxel grids. ``--data`` takes a folder that ``amiwarp dataset`` wrote, with the label
``class``; by default, recordings of moving gratings are made first. Needs ``pip install 'amiwarp[torch]'``.

On a GPU: ``python examples/train_from_files.py --device cuda:0 --recordings 512 --batch 8 --epochs 4``
"""

import argparse
import json
import math
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

import amiwarp

BINS, WINDOW_US = 5, 25_000
DIRECTIONS, DURATION_US, STEP_US, AT_ONCE = 4, 204_000, 2_000, 16  # of the recordings that are made
COLUMNS = {
    "t": np.int64,
    "x": np.uint16,
    "y": np.uint16,
    "p": np.uint8,
}  # in the order of a batch: largest first
EVENT_BYTES, PAGE = sum(np.dtype(kind).itemsize for kind in COLUMNS.values()), 4096


def make_data(folder: Path, recordings: int, device: str) -> None:
    """Write recordings of plain cameras, each of which sees a grating that moves in one of several directions."""
    items, side = [], 128 if device.startswith("cuda") else 64
    y, x = torch.meshgrid(
        *2 * [torch.arange(side, device=device, dtype=torch.float32)], indexing="ij"
    )
    for first in range(0, recordings, AT_ONCE):
        n = min(AT_ONCE, recordings - first)
        random = torch.rand((4, n, 1, 1), generator=torch.Generator().manual_seed(first)).to(device)
        labels = [k % DIRECTIONS for k in range(first, first + n)]
        angle = (torch.tensor(labels, device=device)[:, None, None] + 0.4 * random[0] - 0.2) * (
            math.tau / DIRECTIONS
        )
        length, contrast, speed = (
            8 + 24 * random[1],
            0.2 + 0.25 * random[2],
            0.03 + 0.06 * random[3],
        )  # px, 1, px/ms
        sensor = amiwarp.EventSensor(
            n,
            side,
            side,
            amiwarp.SensorModel.preset("davis346"),
            seed=list(range(first, first + n)),
            device=device,
        )
        parts: list[list[amiwarp.Events]] = [[] for _ in range(n)]
        for t_us in range(0, DURATION_US + 1, STEP_US):
            place = x * torch.cos(angle) + y * torch.sin(angle) - speed * (1e-3 * t_us)
            luminance = 0.5 + contrast * torch.sin(place * (math.tau / length))
            events, cameras = sensor.step(torch.log(luminance + 0.02), t_us)
            host = events.to_host()
            for part, start, stop in zip(
                parts, cameras.start.tolist(), cameras.stop.tolist(), strict=True
            ):
                part.append(host[start:stop])
        for k, (part, label) in enumerate(zip(parts, labels, strict=True), first):
            found = amiwarp.Events.concatenate(part)
            amiwarp.save_recording(
                folder / f"{k}.h5", amiwarp.Recording(amiwarp.MemoryEvents(found, side, side))
            )
            items.append(
                {
                    "file": f"{k}.h5",
                    "split": "train",
                    "labels": {"class": label},
                    "events": len(found),
                }
            )
    manifest = {"format": "amiwarp-dataset", "version": 1, "items": items}
    (folder / "manifest.json").write_text(json.dumps(manifest))


def cut(
    recording: amiwarp.Recording, labels: dict[str, Any]
) -> tuple[list[amiwarp.Events], Any, tuple[int, int]]:
    """Return the events of all windows of a recording, its class, and the size of its sensor.

    Opening a file takes longer than reading a window, so every window of an opened file is used.
    """
    events = recording.events[:]
    windows = amiwarp.windows(events, duration_us=WINDOW_US)
    blocks = [
        events[start:stop]
        for start, stop in zip(windows.start.tolist(), windows.stop.tolist(), strict=True)
    ]
    return blocks, labels["class"], recording.events.size


class Join:
    """Joins the events of several recordings in a worker process, in a slot of memory that all processes share.

    PyTorch would pass each batch in new shared memory. To map and release it takes the main process longer than all
    else that it does for a batch, and it holds Python's lock meanwhile. The slots stay.
    """

    def __init__(self, slots: int, events: int, device: str) -> None:
        size = -(-events * EVENT_BYTES // PAGE) * PAGE
        self.slots = torch.empty((slots, size), dtype=torch.uint8).share_memory_()
        if device.startswith("cuda"):  # page-locked, from which a GPU copies at full speed
            runtime = torch.cuda.cudart()
            torch.cuda.check_error(
                runtime.cudaHostRegister(self.slots.data_ptr(), self.slots.numel(), 0)
            )
        self._free = multiprocessing.get_context("spawn").SimpleQueue()
        for slot in range(slots):
            self.release(slot)

    def __call__(self, items: list[Any]) -> tuple[int, list[int], list[Any]]:
        """Return the slot of the batch, the number of events in each window, and its class."""
        blocks = [block for blocks, _, _ in items for block in blocks]
        slot = self._free.get()
        place = self.slots[slot].numpy()
        for name in COLUMNS:
            columns = [getattr(block, name).view(np.uint8) for block in blocks]
            size = sum(map(len, columns))
            np.concatenate(columns, out=place[:size])
            place = place[size:]
        return (
            slot,
            [len(block) for block in blocks],
            [label for blocks, label, _ in items for _ in blocks],
        )

    def events(self, slot: int, n: int) -> amiwarp.Events:
        """Return the ``n`` events in a slot, without a copy."""
        ends = n * np.cumsum([np.dtype(kind).itemsize for kind in COLUMNS.values()])
        parts = np.split(self.slots[slot].numpy()[: n * EVENT_BYTES], ends[:-1])
        columns = {
            name: part.view(kind) for (name, kind), part in zip(COLUMNS.items(), parts, strict=True)
        }
        return amiwarp.Events(**columns)

    def release(self, slot: int) -> None:
        """Let the next batch use a slot."""
        self._free.put(slot)


class Block(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self, before: int, after: int, stride: int = 1) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU(),
            nn.Conv2d(after, after, 3, 1, 1, bias=False), nn.BatchNorm2d(after),
        )  # fmt: skip
        same = before == after and stride == 1
        self.skip = nn.Identity() if same else nn.Conv2d(before, after, 1, stride, bias=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the output of the block."""
        return torch.relu(self.body(x) + self.skip(x))


def make_network(classes: int, n: int) -> nn.Module:
    """Return a residual network of ``n`` channels in its first layers: with 64 it is ResNet-18, without its pooling."""
    return nn.Sequential(
        nn.Conv2d(BINS, n, 7, 2, 3, bias=False), nn.BatchNorm2d(n), nn.ReLU(), Block(n, n), Block(n, n),
        Block(n, 2 * n, 2), Block(2 * n, 2 * n), Block(2 * n, 4 * n, 2), Block(4 * n, 4 * n),
        Block(4 * n, 8 * n, 2), Block(8 * n, 8 * n), nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(8 * n, classes),
    )  # fmt: skip


def on_device(
    loader: Any, join: Join, names: list[Any], size: tuple[int, int], device: str
) -> Iterator[Any]:
    """Yield the voxel grids and classes of each batch, on the device."""
    for slot, counts, classes in loader:
        ends = np.cumsum([0, *counts])
        found = join.events(slot, int(ends[-1]))
        windows = amiwarp.windows(found, ranges=np.stack([ends[:-1], ends[1:]], axis=1))
        events, _ = amiwarp.collate([found], device=device)
        grids = amiwarp.voxel_grid(
            events, *size, BINS, windows=windows, normalize=True, device=device
        )
        join.release(slot)
        yield (
            torch.from_dlpack(grids),
            torch.tensor([names.index(c) for c in classes], device=device),
        )


def main() -> None:
    """Train, and print how much longer a batch takes than one that is kept on the device."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, help="folder of a data set; by default one is made")
    parser.add_argument("--recordings", type=int, default=2, help="number of recordings to make")
    parser.add_argument("--batch", type=int, default=1, help="recordings in a batch")
    parser.add_argument(
        "--epochs", type=int, default=2, help="epochs; the first one is not measured"
    )
    parser.add_argument(
        "--workers", type=int, default=max(1, (os.cpu_count() or 1) - 2), help="reading processes"
    )
    parser.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--width", type=int, help="channels of the network's first layers; default 64, on a CPU 16"
    )
    given = parser.parse_args()
    given.width = given.width or (64 if given.device.startswith("cuda") else 16)
    if given.epochs < 2:
        parser.error(
            f"--epochs is {given.epochs}; give at least 2, because the first one is not measured"
        )
    with tempfile.TemporaryDirectory() as made:
        if given.data is None:
            make_data(Path(made), given.recordings, given.device)
        train(given.data or Path(made), given)


def train(folder: Path, given: argparse.Namespace) -> None:
    """Train on a data set."""
    dataset = amiwarp.RecordedDataset(folder, split="train", transform=cut)
    names = sorted({labels["class"] for labels in dataset.labels})
    size = dataset[0][2]
    # One pass over the loader for all epochs, so that the workers go on reading from one epoch to the next. One batch
    # more is read while the network trains on the last one, so that the end of the workers is not measured.
    epoch = max(1, len(dataset) // given.batch)  # batches
    steps = given.epochs * epoch
    torch.manual_seed(0)
    order = torch.utils.data.RandomSampler(dataset, num_samples=(steps + 1) * given.batch)
    items = json.loads((folder / "manifest.json").read_text())["items"]
    most = given.batch * max(item["events"] for item in items)
    join = Join(2 * given.workers + 1, most, given.device)  # each worker reads two batches ahead
    loader = torch.utils.data.DataLoader(
        dataset, given.batch, sampler=order, collate_fn=join, num_workers=given.workers,
        multiprocessing_context="spawn" if given.workers else None,
    )  # fmt: skip
    network = make_network(len(names), given.width).to(given.device)
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)

    def step(grids: torch.Tensor, classes: torch.Tensor) -> torch.Tensor:
        loss = nn.functional.cross_entropy(network(grids), classes)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        return loss

    losses, windows, begun = [], 0, 0.0
    # On a stream of its own, the network does not wait for copies and voxel grids.
    with torch.cuda.stream(
        torch.cuda.Stream(given.device) if given.device.startswith("cuda") else None
    ):
        batches = on_device(loader, join, names, size, given.device)
        following = next(batches)
        for k in range(steps):
            if k == epoch:
                begun, windows = time.perf_counter(), 0
            batch = following  # its memory must not be used again before the network has finished
            loss = step(*batch)
            following = next(batches)
            losses.append(loss.item())  # waits for the network
            windows += len(batch[0])
        total = time.perf_counter() - begun
        begun = time.perf_counter()
        for _ in range(steps - epoch):
            step(*batch).item()
        kept = time.perf_counter() - begun
    print(
        f"{sum(p.numel() for p in network.parameters()) / 1e6:.2f} million parameters, {size[0]}x{size[1]} px"
    )
    first, last = (sum(part) / len(part) for part in (losses[:epoch], losses[-epoch:]))
    print(f"mean loss {first:.2f} in the first epoch, {last:.2f} in the last one")
    print(f"{windows} windows in {total:.2f} s on {given.device}, {windows / total:.3g} per second")
    took, alone = 1e3 * total / (steps - epoch), 1e3 * kept / (steps - epoch)
    print(f"a batch takes {took:.2f} ms, one that stays on the device {alone:.2f} ms: "
          f"reading costs {1 - kept / total:.2%}")  # fmt: skip


if __name__ == "__main__":
    main()
