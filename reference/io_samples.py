"""Small valid files of every format, made from the same events."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
from faery.extension import aedat, dat, es, evt

from amiwarp import AmiwarpError, Camera, Encoder, Events, RadialTangential, RecordingWriter

SIZE = (320, 240)
CALIB = "200 201 150 110 -0.3 0.1 1e-4 -2e-4 0.01"
FAERY = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), (("p", "on"), "?")])


def make_events(count: int = 600, seed: int = 0) -> Events:
    """Random events over the whole frame, from 1 s on. Some share a time."""
    rng = np.random.default_rng(seed)
    t = 1_000_000 + np.cumsum(rng.integers(0, 30, count))
    x, y = (rng.integers(0, side, count) for side in SIZE)
    x[1], y[1] = SIZE[0] - 1, SIZE[1] - 1
    return Events.from_arrays(x, y, t, rng.integers(0, 2, count))


def to_faery(events: Events) -> np.ndarray:
    packet = np.zeros(len(events), FAERY)
    for name in ("t", "x", "y", "p"):
        packet[name] = getattr(events, name)
    return packet


def write_evt(
    version: str, *, dimensions: tuple[int, int] = SIZE
) -> Callable[[Path, Events], None]:
    def write(path: Path, events: Events) -> None:
        with evt.Encoder(path, version, False, dimensions, True) as encoder:
            encoder.write({"events": to_faery(events)})

    return write


def write_dat(path: Path, events: Events) -> None:
    packet = np.zeros(len(events), [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("payload", "u1")])
    for name, field in (("t", "t"), ("x", "x"), ("y", "y"), ("payload", "p")):
        packet[name] = getattr(events, field)
    with dat.Encoder(path, "dat2", "cd", False, SIZE) as encoder:
        encoder.write(packet)


def write_aedat4(path: Path, events: Events) -> None:
    attribute, node = aedat.DescriptionAttribute, aedat.DescriptionNode
    size = {
        "sizeX": attribute("int", SIZE[0]),
        "sizeY": attribute("int", SIZE[1]),
        "source": attribute("string", "test"),
    }
    stream = {
        "compression": attribute("string", "LZ4"),
        "originalModuleName": attribute("string", "test"),
        "originalOutputName": attribute("string", "events"),
        "typeDescription": attribute("string", "Array of events (polarity ON/OFF)."),
        "typeIdentifier": attribute("string", "EVTS"),
    }
    info = node("info", "/mainloop/Recorder/outInfo/0/info/", size, [])
    output = node("0", "/mainloop/Recorder/outInfo/0/", stream, [info])
    with aedat.Encoder(
        path, [node("outInfo", "/mainloop/Recorder/outInfo/", {}, [output])], ("lz4", 1)
    ) as encoder:
        for start in range(0, len(events), 200):
            encoder.write(0, to_faery(events[start : start + 200]))


def write_es(path: Path, events: Events) -> None:
    packet = to_faery(events)
    packet["y"] = SIZE[1] - 1 - packet["y"]
    with es.Encoder(path, "dvs", False, SIZE) as encoder:
        encoder.write(packet)


def write_text(path: Path, events: Events) -> None:
    rows = zip(
        events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True
    )
    path.write_text("".join(f"{t / 1e6:.6f} {x} {y} {p}\n" for t, x, y, p in rows))
    path.with_name("calib.txt").write_text(CALIB)


def write_npz(path: Path, events: Events) -> None:
    np.savez(path, x=events.x, y=events.y, t=events.t, p=events.p, width=SIZE[0], height=SIZE[1])


def write_native(path: Path, events: Events) -> None:
    camera = Camera(*SIZE, 200.0, 201.0, 150.0, 110.0, RadialTangential(-0.3, 0.1))
    encoder = Encoder.constant_speed(3000.0, 999_000, int(events.t[-1]))
    points = np.zeros((len(events), 2), np.float32)
    with RecordingWriter(
        path,
        width=SIZE[0],
        height=SIZE[1],
        camera=camera,
        encoder=encoder,
        truth_parameters={"apex": 0.03},
    ) as writer:
        writer.append(events, truth_points=points)


def write_dsec(path: Path, events: Events) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["width"], file.attrs["height"] = SIZE
        relative = events.t - 1_000_000
        for name, values in (
            ("x", events.x),
            ("y", events.y),
            ("t", relative.astype("u4")),
            ("p", events.p),
        ):
            blosc = hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.SHUFFLE)
            file.create_dataset(f"events/{name}", data=values, chunks=(200,), compression=blosc)
        file["t_offset"] = np.int64(1_000_000)
        file["ms_to_idx"] = np.searchsorted(relative, 1000 * np.arange(relative[-1] // 1000 + 1))


WRITERS: dict[str, tuple[str, str, Callable[[Path, Events], None]]] = {
    # name: (format in the metadata, file ending, writer)
    "evt2": ("evt2.0", "raw", write_evt("evt2")),
    "evt3": ("evt3.0", "raw", write_evt("evt3")),
    "dat": ("dat2", "dat", write_dat),
    "aedat4": ("aedat4", "aedat4", write_aedat4),
    "es": ("es", "es", write_es),
    "text": ("text", "txt", write_text),
    "npz": ("npz", "npz", write_npz),
    "native": ("native", "h5", write_native),
    "dsec": ("dsec", "h5", write_dsec),
}


def refusal(call: Callable[..., object], *arguments: object) -> str | None:
    """Return the message of the AmiwarpError that a call raises, or None if it raises none."""
    try:
        call(*arguments)
    except AmiwarpError as error:
        return str(error)
    return None


def write_sample(folder: Path, name: str, events: Events, *, ending: str | None = None) -> Path:
    """Write the events in one of the formats of :data:`WRITERS`. ``ending`` replaces the usual file ending."""
    _, usual, writer = WRITERS[name]
    path = folder / f"sample.{usual}"
    writer(path, events)
    return path if ending is None else Path(shutil.move(path, folder / f"sample.{ending}"))
