"""Files of plain columns: names, order, unit and polarity are found, and said; in doubt, an option is named.

The layouts are those that users of other readers write or report. Each file is made here.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import loadmat, savemat

from amiwarp import (
    AmiwarpError,
    Camera,
    Events,
    MemoryEvents,
    Recording,
    convert,
    open_recording,
    save_recording,
)
from amiwarp.calib.checks import size_warnings
from amiwarp.io.assumptions import assumptions_of
from amiwarp.io.columns import parquet as parquet_arrays
from amiwarp.io.columns.names import role_of, roles_of, unit_in
from amiwarp.io.text import reader as text_files
from reference.io_samples_extra import write_raw_of_a_sensor

N = 1000
RANDOM = np.random.default_rng(0)
X, Y = RANDOM.integers(0, 640, N), RANDOM.integers(0, 480, N)
X[0], Y[0] = 639, 479
T = np.sort(RANDOM.integers(0, 100_000, N))
P = RANDOM.integers(0, 2, N)
SECONDS = T / 1e6
EPOCH = 1_700_000_000_000_000
"""A time in 2023 [us]."""

Maker = Callable[[Path], None]


def lines(
    rows: Any, *, separator: str = " ", head: str = "", end: str = "\n", encoding: str = "utf-8"
) -> Maker:
    """Return a function that writes rows of text below a head."""

    def write(path: Path) -> None:
        path.write_bytes(
            (head + "".join(separator.join(map(str, row)) + end for row in rows)).encode(encoding)
        )

    return write


def archive(*arrays: Any, compressed: bool = False, **named: Any) -> Maker:
    """Return a function that writes an archive of arrays."""

    def write(path: Path) -> None:
        with open(path, "wb") as file:
            (np.savez_compressed if compressed else np.savez)(file, *arrays, **named)

    return write


def in_utf16(maker: Maker, encoding: str, mark: bytes) -> Maker:
    """Return a function that writes a maker's text in UTF-16."""

    def write(path: Path) -> None:
        maker(path)
        path.write_bytes(mark + path.read_bytes().decode().encode(encoding))

    return write


def array(values: Any) -> Maker:
    """Return a function that writes one array."""

    def write(path: Path) -> None:
        with open(path, "wb") as file:
            np.save(file, values)

    return write


def hdf5(
    attributes: dict[str, Any] | None = None, units: dict[str, str] | None = None, **datasets: Any
) -> Maker:
    """Return a function that writes an HDF5 file. ``__`` in a name stands for ``/``."""

    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            for name, values in datasets.items():
                file[name.replace("__", "/")] = values
            for name, unit in (units or {}).items():
                file[name].attrs["unit"] = unit
            file.attrs.update(attributes or {})

    return write


def matlab(**variables: Any) -> Maker:
    """Return a function that writes a MATLAB 5 file."""
    return lambda path: savemat(path, variables, appendmat=False)


def matlab_73(path: Path) -> None:
    """Write a structure as MATLAB 7.3 does: HDF5 behind a block of text, with columns as rows."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("x", X), ("y", Y), ("ts", T), ("p", P)):
            file[f"TD/{name}"] = values.reshape(1, -1).astype(float)
        file["#refs#/a"] = np.zeros(3)
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128))


def parquet(**columns: Any) -> Maker:
    """Return a function that writes a Parquet table in groups of 300 rows."""
    return lambda path: pq.write_table(pa.table(columns), path, row_group_size=300)


def records(*fields: tuple[str, str], values: tuple[Any, ...]) -> Any:
    """Return an array of records."""
    rows = np.zeros(N, list(fields))
    for (name, _), column in zip(fields, values, strict=True):
        rows[name] = column
    return rows


def openmv(kinds: Any) -> Any:
    """Return the array of OpenMV's GenX320: type, s, ms, us, x, y."""
    t = T + 2_345_000
    return np.c_[kinds, t // 1_000_000, t // 1000 % 1000, t % 1000, X // 2, Y * 2 // 3].astype(
        "<u2"
    )


RECORDS = records(("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?"), values=(T, X, Y, P))
ROWS = np.c_[T, X, Y, P]
SECOND_ROWS = [(f"{t:.6f}", x, y, p) for t, x, y, p in zip(SECONDS, X, Y, P, strict=True)]
COMMAS = [(t.replace(".", ","), *rest) for t, *rest in SECOND_ROWS]
START = datetime(2024, 5, 1, 12)
START_US = 1_714_564_800_000_000
"""The same time since 1970 [us]."""


def dates(separator: str = "T", zone: str = "", *, hours: int = 0) -> list[tuple[Any, ...]]:
    """Return rows whose times are dates, in a zone some hours east."""
    shift = timedelta(hours=hours)
    return [
        (
            (START + shift + timedelta(microseconds=int(t))).isoformat(separator, "microseconds")
            + zone,
            x,
            y,
            p,
        )
        for t, x, y, p in ROWS.tolist()
    ]


def worded(off: str, on: str) -> list[tuple[Any, ...]]:
    """Return rows whose polarities are words."""
    return [(t, x, y, (off, on)[p]) for t, x, y, p in ROWS.tolist()]


WORDS = np.array(["False", "True"])[P]
SIGNED = 2 * P - 1

LAYOUTS: dict[str, tuple[Maker, dict[str, Any]]] = {
    # name: (maker, options)
    "text: whole microseconds": (lines(ROWS), {}),
    "text: np.savetxt of microseconds": (lines([[f"{v:.18e}" for v in row] for row in ROWS]), {}),
    "text: %f of microseconds": (lines([[f"{t:.6f}", *row] for t, *row in ROWS.tolist()]), {}),
    "text: x y t p": (lines(np.c_[X, Y, T, P]), {}),
    "text: x y t p in seconds": (lines(zip(X, Y, SECONDS, P, strict=True)), {}),
    "text: x y p t": (lines(np.c_[X, Y, P, T], separator="\t", end="\r\n"), {}),
    "text: polarity first": (lines(np.c_[P, X, Y, T]), {}),
    "text: -1 and 1": (lines(np.c_[T, X, Y, SIGNED]), {}),
    "text: names in a comment": (lines(np.c_[Y, X, T, P], head="# recorded\n# y x t_us p\n"), {}),
    "csv of Metavision": (lines(np.c_[X, Y, P, T], separator=",", head="%geometry:640,480\n"), {}),
    "csv with names": (lines(np.c_[T, X, Y, P], separator=",", head="t,x,y,p\n"), {}),
    "csv of pandas": (
        lines(
            zip(range(N), SECONDS, X, Y, WORDS, strict=True), separator=",", head=",timestamp [s],x,y,polarity\n"
        ),
        {},
    ),
    "csv with a decimal comma": (
        lines([(t.replace(".", ","), x, y, p) for t, x, y, p in SECOND_ROWS], separator=";", head="Time (s);x;y;pol\n"),
        {},
    ),
    "csv with a mark, without names": (lines(ROWS, separator=";", head="\ufeff"), {}),
    "csv with few decimal commas": (
        lines([(str(k / 4).replace(".", ",").removesuffix(",0"), *row[1:]) for k, row in enumerate(ROWS.tolist())],
              separator=";", head="t_ms;x;y;p\n"),
        {},
    ),
    "csv with quoted decimal commas": (
        lines([(f'"{t}"', *rest) for t, *rest in COMMAS], separator=",", head="t,x,y,p\n"), {"time_unit": "s"},
    ),
    "csv with quoted decimal commas between semicolons": (
        lines([(f'"{t}"', *rest) for t, *rest in COMMAS], separator=";"), {},
    ),
    "text with decimal commas between tabs": (lines(COMMAS, separator="\t", head="t\tx\ty\tp\n"), {}),
    "text with decimal commas between spaces": (lines(COMMAS), {}),
    "text in UTF-16 of Excel": (
        in_utf16(lines(ROWS, separator="\t", head="t\tx\ty\tp\r\n", end="\r\n"), "utf-16-le", b"\xff\xfe"), {},
    ),
    "text in UTF-16, big-endian": (in_utf16(lines(SECOND_ROWS), "utf-16-be", b"\xfe\xff"), {}),
    "csv with + and -": (lines(worded("-", "+"), separator=",", head="t,x,y,p\n"), {}),
    "csv with y and n": (lines(worded("n", "y"), separator=",", head="t,x,y,p\n"), {}),
    "csv with ON and OFF": (lines(worded("OFF", "ON"), separator=";", head="t;x;y;p\n"), {}),
    "text with true and false": (lines(worded("false", "true")), {}),
    "csv with a last comma in the names": (lines(ROWS, separator=",", head="t,x,y,p,\n"), {}),
    "csv with a last comma in the lines": (lines(ROWS, separator=",", head="t,x,y,p\n", end=",\n"), {}),
    "csv with last commas everywhere": (lines(ROWS, separator=",", head="t,x,y,p,,\n", end=",,\r\n"), {}),
    "csv with empty columns": (
        lines([("", t, "", " ", x, y, p) for t, x, y, p in ROWS.tolist()], separator=",",
              head="id,t,label,track,x,y,p\n"),
        {},
    ),
    "text: names in an earlier comment": (
        lines(np.c_[Y, X, T, P], head="# columns: y x t_us p\n# 1000 events\n"), {},
    ),
    "text: names between commas in a comment of MATLAB": (lines(np.c_[Y, X, T, P], head="% y,x,t_us,p\n"), {}),
    "text: names and units between commas in a comment": (
        lines(np.c_[Y, X, T, P], head="# Format: y [px], x [px], time [us], p\n"), {},
    ),
    "csv of Windows": (lines(ROWS, separator=";", head="time [µs];x;y;p\n", end="\r\n", encoding="latin-1"), {}),
    "text: names with units apart": (lines(np.c_[Y, X, T, P], head="y x time [us] p\n"), {}),
    "csv of pandas, read and written again": (
        lines(zip(range(N), *ROWS.T, strict=True), separator=",", head="Unnamed: 0,t,x,y,p\n"), {},
    ),
    "csv: usec, u, v, on_off": (lines(ROWS, separator=",", head="usec,u,v,on_off\n"), {}),
    "csv: nanoseconds, pixel_x, pixel_y, polarity_bool": (
        lines(np.c_[T * 1000, X, Y, P], separator=",", head="nanoseconds,pixel_x,pixel_y,polarity_bool\n"), {},
    ),
    "csv: flow beside the pixels": (
        lines(np.c_[T, X, Y, P, Y, X], separator=",", head="time_in_us,x,y,sign,u,v\n"), {},
    ),
    "npz: u, v": (archive(u=X, v=Y, msec=T / 1e3, sign=SIGNED), {}),
    "text below many comments": (lines(ROWS, head="# a long story about the recording\n" * 200), {}),
    "csv with a mark and quotes": (
        lines([[f'"{v}"' for v in row] for row in ROWS], separator=",", head='\ufeff"Timestamp(us)","X","Y","P"\n'),
        {},
    ),
    "csv with further columns": (
        lines(np.c_[X, Y, P, T, T * 0 + 7, T * 0], separator=",", head="col,row,on,time_us,label,track\n"),
        {},
    ),
    "csv in nanoseconds": (lines(np.c_[T * 1000, X, Y, P], separator=",", head="time_ns,x,y,p\n"), {}),
    "csv in milliseconds": (lines(zip(T / 1e3, X, Y, P, strict=True), separator=",", head="t_ms,x,y,p\n"), {}),
    "csv, ms by option": (
        lines(zip(T / 1e3, X, Y, P, strict=True), separator=",", head="t,x,y,p\n"),
        {"time_unit": "ms"},
    ),
    "text, order by option": (lines(np.c_[T * 0 + 5, Y, X, T, P]), {"columns": "-,y,x,t,p"}),
    "npz: xs ys ts ps": (archive(xs=X, ys=Y, ts=SECONDS, ps=P.astype(bool)), {}),
    "npz: 255 is OFF": (archive(x=X, y=Y, t=T, p=np.where(P, 1, 255).astype("u1")), {}),
    "npz: -1 in 32 bits": (archive(x=X, y=Y, t=T, p=np.where(P, 1, 2**32 - 1).astype("u4")), {}),
    "npz: -1 in 16 bits": (archive(x=X, y=Y, t=T, p=np.where(P, 1, -1).astype("u2")), {}),
    "npz: 1 and 2 by option": (archive(x=X, y=Y, t=T, p=2 - P), {"polarity": "1=on,2=off"}),
    "npz: True is OFF by option": (archive(x=X, y=Y, t=T, p=P == 0), {"polarity": "0=on,1=off"}),
    "npz: x times 32": (archive(x=(X * 32).astype("u2"), y=(Y * 32).astype("u2"), t=T, p=P), {"scale_xy": 32}),
    "npz: events in floating microseconds": (archive(events=ROWS.astype(float)), {}),
    "npz: events of integers": (archive(events=ROWS), {}),
    "npz: events of records": (archive(events=RECORDS, K=np.eye(3)), {}),
    "npz: arr_0 by columns": (archive(np.stack([T, X, Y, P]).T, compressed=True), {}),
    "npz: arr_0 of seconds": (archive(np.c_[X, Y, SECONDS, SIGNED]), {}),
    "npz: one array of any name": (archive(dvs=np.c_[X, Y, T, P]), {}),
    "npz: names by option": (archive(a=X, b=Y, c=T, d=P, e=np.eye(2)), {"columns": "t=c,x=a,y=b,p=d"}),
    "npz: text and objects beside": (
        archive(xs=X, ys=Y, ts=T, ps=P, sensor="davis", names=np.array(["a", "b"]), notes=np.array([{}, None])), {},
    ),
    "npz: text beside names by option": (
        archive(a=X, b=Y, c=T, d=P, label=np.array(["u", "v"])), {"columns": "t=c,x=a,y=b,p=d"},
    ),
    "npz: order by option beside other arrays": (
        archive(events=np.c_[T, Y, X, P], K=np.eye(3), D=np.zeros(5), index=np.arange(4)), {"columns": "t,y,x,p"},
    ),
    "npz: names by option beside events": (
        archive(events=np.zeros((N, 4)), a=X, b=Y, c=T, d=P), {"columns": "t=c,x=a,y=b,p=d"},
    ),
    "npz: floating t": (archive(x=X, y=Y, t=SECONDS, p=P), {}),
    "npy by columns": (array(np.asfortranarray(ROWS)), {}),
    "npy by rows": (array(np.c_[X, Y, P, T].astype("<u4")), {}),
    "npy of rows per property": (array(np.stack([SECONDS, X, Y, SIGNED])), {}),
    "npy of records": (array(RECORDS), {}),
    "npy of big-endian integers": (array(np.c_[T, X, Y, P].astype(">i4")), {}),
    "npy of records of tonic": (
        array(records(("x", "<i2"), ("y", "<i2"), ("timestamp", "<i4"), ("polarity", "i1"), values=(X, Y, T, SIGNED))),
        {},
    ),
    "HDF5: matrix of v2e": (hdf5(events=ROWS.astype("u4")), {}),
    "HDF5: matrix of v2e with -1": (hdf5(events=np.c_[T, X, Y, SIGNED].astype("i8").astype("u4")), {}),
    "HDF5: events/xs of event_utils": (
        hdf5({"sensor_resolution": (480, 640)}, events__xs=X.astype("i2"), events__ys=Y, events__ts=SECONDS,
             events__ps=P.astype(bool), images__image000=np.zeros((4, 4))),
        {},
    ),
    "HDF5: root": (hdf5(x=X, y=Y, t=T, p=P), {}),
    "HDF5: events/t in seconds": (hdf5(events__x=X, events__y=Y, events__t=SECONDS, events__p=P), {}),
    "HDF5: events/p of 1 and 255": (
        hdf5(events__x=X, events__y=Y, events__t=T, events__p=np.where(P, 1, 255).astype("u1")),
        {},
    ),
    "HDF5: other names in events": (hdf5(events__x=X, events__y=Y, events__timestamp=T, events__polarity=P), {}),
    "HDF5: records": (hdf5(dvs=RECORDS), {}),
    "HDF5: unit of a dataset": (hdf5(units={"t": "ms"}, x=X, y=Y, t=T / 1e3, p=P), {}),
    "HDF5: deep groups": (
        hdf5(davis__left__dvs__x=X, davis__left__dvs__y=Y, davis__left__dvs__ts=T, davis__left__dvs__pol=P), {},
    ),
    "HDF5: names by option": (
        hdf5(a__x=X, a__y=Y, a__t=T, a__p=P, b__x=Y, b__y=Y, b__t=T, b__p=P),
        {"columns": "t=a/t,x=a/x,y=a/y,p=a/p"},
    ),
    "HDF5: unit by option": (
        hdf5(events__x=X, events__y=Y, events__t=T * 1000, events__p=P),
        {"time_unit": "ns"},
    ),
    "MATLAB: structure of ATIS": (
        matlab(TD={"x": X, "y": Y, "ts": T, "p": P + 1}), {"polarity": "1=off,2=on"},
    ),
    "MATLAB: columns": (matlab(x=X.reshape(-1, 1), y=Y.reshape(-1, 1), t=SECONDS.reshape(-1, 1), pol=SIGNED), {}),
    "MATLAB: matrix in a structure": (matlab(events={"name": "a", "e_data": np.stack([SECONDS, X, Y, P])}), {}),
    "MATLAB 7.3": (matlab_73, {}),
    "Parquet": (parquet(t=T, x=X.astype("u2"), y=Y.astype("u2"), polarity=P.astype(bool)), {}),
    "Parquet with durations": (
        parquet(timestamp=pa.array(T.astype("m8[us]")), x=X, y=Y, p=P, label=["a"] * N), {},
    ),
}  # fmt: skip


def made(folder: Path, maker: Maker) -> Path:
    """Write a file without an extension, as the content decides."""
    maker(folder / "events")
    return folder / "events"


def of(recording: Recording) -> Events:
    return recording.events.slice(0, len(recording.events))


def assert_same(recording: Recording, shift: int = 0) -> None:
    """Check that a recording holds the events of this page, ``shift`` [us] later."""
    events = of(recording)
    for name, expected in (("x", X), ("y", Y), ("t", T + shift), ("p", P)):
        np.testing.assert_array_equal(getattr(events, name), expected, err_msg=name)


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_are_found(tmp_path: Path, name: str) -> None:
    maker, options = LAYOUTS[name]
    recording = open_recording(made(tmp_path, maker), **options)
    if "few decimal commas" in name:
        np.testing.assert_array_equal(of(recording).t, 250 * np.arange(N))
    else:
        assert_same(recording)
    assert recording.events.size == (640, 480)


@pytest.mark.parametrize(
    "name", ["csv with names", "npy by columns", "HDF5: root", "npz: arr_0 by columns"]
)
def test_large_files_are_read_in_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("amiwarp.io.file_scan.KEEP_EVENTS", 0)
    monkeypatch.setattr("amiwarp.io.numpy_arrays.DEFAULT_BLOCK", 300)
    monkeypatch.setattr("amiwarp.io.text.reader.READ_BYTES", 500)
    recording = open_recording(made(tmp_path, LAYOUTS[name][0]))
    assert_same(recording)
    assert_same(recording)


COUNT = np.arange(60_000)


@pytest.mark.parametrize(
    ("separator", "head"),
    [(" ", ""), (",", "t,x,y,p\n"), ("\t", "")],
    ids=["spaces", "commas", "tabs"],
)
def test_the_kernel_reads_as_numpy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, separator: str, head: str
) -> None:
    """Decimal numbers of any length are rounded alike."""
    count = 9000  # for three threads
    rng = np.random.default_rng(1)
    t = np.sort(rng.random(count)) * 1000 - 3
    texts = [
        f"{value:.{digits}f}" for value, digits in zip(t, rng.integers(6, 13, count), strict=True)
    ]
    rows = list(zip(texts, rng.integers(0, 640, count), rng.integers(0, 480, count), rng.integers(0, 2, count),
                    strict=True))  # fmt: skip
    path = made(tmp_path, lines(rows, separator=separator, head=head, end="\r\n" if head else "\n"))
    slow = of(open_recording(path, time_unit="s"))
    monkeypatch.setattr("amiwarp.io.text.reader.KERNEL_LINES", 100)
    calls: list[int] = []
    monkeypatch.setattr("amiwarp.io.text.reader.THREAD_LINES", 4000)
    table = text_files._plain_table

    def counted(*arguments: Any) -> Any:
        found = table(*arguments)
        calls.append(0 if found is None else len(found))
        return found

    monkeypatch.setattr("amiwarp.io.text.reader._plain_table", counted)
    fast = of(open_recording(path, time_unit="s"))
    assert calls == [count]
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(fast, name), getattr(slow, name), err_msg=name, strict=True
        )
    np.testing.assert_array_equal(slow.t, np.rint([float(text) * 1e6 for text in texts]))


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("1e-1 5 6 1", True), ("0.1  5 6 1 ", True), ("# a comment", True), ("", True), ("0.1 05 006 1", True),
        ("0.1 5 6 1.000000000000000000000", True), ("0.1 5 6", False), ("0.1 5 6 1 1", False), ("0.1 5 6 -", False),
        ("0.1 5 6 .", False), ("0.1.2 5 6 1", False), ("0.1 5 6 1-", False), ("0.1 5 6 --1", False),
        ("0.1 5 6 99999999999999999999", False), ("0.1 5 6 x", False),
    ],
)  # fmt: skip
def test_the_kernel_leaves_other_lines_to_numpy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, told: bool
) -> None:
    monkeypatch.setattr("amiwarp.io.text.reader.KERNEL_LINES", 100)
    rows = [f"{0.001 * k:.6f} {k} {k} 1" for k in range(200)]
    path = tmp_path / "a.txt"
    path.write_text("\n".join([*rows[:100], line, *rows[100:]]))
    if told:
        assert len(open_recording(path).events) == 201 - line.startswith("#") - (not line)
    else:
        with pytest.raises(AmiwarpError, match=r"line 101 is"):
            open_recording(path)


REFUSED: dict[str, tuple[Maker, str]] = {
    "a speed is no row": (
        lines(ROWS, separator=",", head="t,x,v,p\n"),
        r"no column is named as y; .* --columns, such as t=t,x=x,y=NAME,p=p$",
    ),
    "one array of another name": (
        archive(xs=X, ys=Y, ts=T, q=P), r"no array .* xs, ys, ts, q; .* --columns, such as t=ts,x=xs,y=ys,p=NAME$",
    ),
    "one dataset of another name": (
        hdf5(a__x=X, a__y=Y, a__t=T, a__q=P, K=np.eye(3)), r"no arrays .* --columns, such as t=a/t,x=a/x,y=a/y,p=NAME$",
    ),
    "times in two parts": (
        lines(np.c_[T, T, X, Y, P], separator=",", head="sec,nsec,x,y,p\n"),
        r"columns sec and nsec can both be t; .* such as t=sec,x=x,y=y,p=p; if they are parts of one time, join them",
    ),
    "times in two parts, one with a usual name": (
        lines(np.c_[T, T, X, Y, P], separator=",", head="time_s,nsec,x,y,p\n"),
        r"columns time_s and nsec can both be t; .* join them in one column first",
    ),
    "numbers of rows without a name": (
        lines(zip(range(N), *ROWS.T, strict=True), head="t x y p\n"),
        r"names 4 columns \(t, x, y, p\), and its rows have 5; .* --columns, such as -,t,x,y,p$",
    ),
    "commas between thousands": (
        lines([(f'"{t + 1000:,}"', *rest) for t, *rest in ROWS.tolist()], separator=","),
        r"line 1 or one after it holds '1,191', whose comma can be a decimal one or separate thousands",
    ),
    "text in UTF-16 without a mark": (
        in_utf16(lines(ROWS), "utf-16-le", b""), r"is text in UTF-16 without a mark at its beginning; save it in UTF-8",
    ),
    "a column of text": (
        lines([(*row, "car") for row in ROWS.tolist()], separator=",", head="t,x,y,p,label\n"),
        r"is text, but line 2 '191,639,479,0,car' holds 'car', which is no number; .* leave out other columns",
    ),
    "times of day": (
        lines([(stamp[11:], *rest) for stamp, *rest in dates()], separator=",", head="t,x,y,p\n"),
        r"line 2 '12:00:00.000191,.*' holds '12:00:00.000191', which is no number; .* such as 2024-05-01T12:",
    ),
    "a missing value in the first row": (
        lines([(T[0], "NA", 5, 1), *ROWS.tolist()], separator=",", head="t,x,y,p\n"),
        r"is text, but line 2 '191,NA,5,1' holds 'NA', which is no number",
    ),
    "a missing value in a later row": (
        lines([*ROWS.tolist(), (T[-1], 5, "NA", 1)], separator=",", head="t,x,y,p\n"),
        r"line 1002 is '\d+,5,NA,1' and holds 'NA', which is no number; expected 't x y p'",
    ),
    "an empty value": (
        lines([*ROWS.tolist(), (T[-1], 5, "", 1)], separator=",", head="t,x,y,p\n"),
        r"line 1002 is '\d+,5,,1', in which y has no value; expected",
    ),
    "a date in the first row": (
        lines([("2024-05-01", 5, 6, 1), *dates()], separator=",", head="t,x,y,p\n"),
        r"line 2 '2024-05-01,5,6,1' holds '2024-05-01', which is a date without a time of day, such as T00:00:00; ",
    ),
    "a date in a later row": (
        lines([*dates(), ("2024-05-02", 5, 6, 1)], separator=",", head="t,x,y,p\n"),
        r"line 1002 is '2024-05-02,5,6,1' and holds '2024-05-02', which is a date without a time of day",
    ),
    "fractions in some rows": (
        lines([(t, x + 0.5 * (t % 4 == 1), y, p) for t, x, y, p in ROWS.tolist()], separator=","),
        r"line \d+ is '\d+,\d+\.5,\d+,[01]', in which x has a fraction; expected",
    ),
    "a fraction of y": (
        lines([*ROWS.tolist(), (T[-1], 5, 6.5, 1)], separator=","), r"line 1001 is '.*', in which y has a fraction; ",
    ),
    "underscores between thousands": (
        lines([(f"{t:_}", *rest) for t, *rest in ROWS.tolist()], separator=",", head="t,x,y,p\n"),
        r"line \d+ is '1_\d+,\d+,\d+,[01]' and holds '1_\d+', which is no number; expected",
    ),
    "underscores between thousands in the first row": (
        lines([(f"{t + 1000:_}", *rest) for t, *rest in ROWS.tolist()], separator=",", head="t,x,y,p\n"),
        r"is text, but line 2 '1_191,.*' holds '1_191', which is no number",
    ),
    "narrow spaces between thousands": (
        lines([(f"{t:,}".replace(",", "\u202f"), *rest) for t, *rest in ROWS.tolist()], separator=";"),
        r"and holds '1\\u202f\d+', which is no number",
    ),
    "a unit that is not the one in the name": (
        lines(ROWS, separator=",", head="t_ms,x,y,p\nus,px,px,-\n"),
        r"line 2 gives the unit us for column t_ms; change the name or the line",
    ),
    "a second line that holds more than units": (
        lines(ROWS, separator=",", head="t,x,y,p\nus,left,px,-\n"),
        r"is text, but line 2 'us,left,px,-' holds neither numbers nor only units; leave it out",
    ),
    "days since 1900": (
        lines([(f"{45413.5 + t / 86400e6:.9f}", *rest) for t, *rest in ROWS.tolist()], separator=",", head="t,x,y,p\n"),
        r"times from 45413\.5\d* may be days since 1900, as Excel counts them, or seconds; .* --time-unit s",
    ),
    "days since 1900 without names": (
        lines([(f"{45413.5 + t / 86400e6:.9f}", *rest) for t, *rest in ROWS.tolist()]), r"may be days since 1900",
    ),
    "a rate that no camera has, with fractions": (
        lines([(f"{5 + k % 2 * 5e-7!r}", k % 640, k % 7, k % 2) for k in range(2500)], separator=",", head="t,x,y,p\n"),
        r"times have fractions, and the first 2,500 events span 5e-07, in which no camera sends .* --time-unit",
    ),
    "a date that is none": (
        lines([("2024-05-32T12:00:00", *rest) for _, *rest in dates()], separator=","),
        r"holds '2024-05-32T12:00:00', which is no number",
    ),
    "prose": (
        lines([], head="hello world\nthis is no table\n"),
        r"is text, but line 1 'hello world' holds no numbers; expected rows of t, x, y and p",
    ),
    "polarity 1 and 2": (archive(x=X, y=Y, t=T, p=2 - P), r"values 1, 2, of which .* --polarity, such as 1=on,2=off"),
    "polarity 0 and -1": (archive(x=X, y=Y, t=T, p=-P), r"values -1, 0, of which .* --polarity"),
    "polarity -1, 0, 1": (array(np.c_[T, X, Y, RANDOM.integers(-1, 2, N)]), r"values -1, 0, 1, of which"),
    "polarity 0 and 255": (archive(x=X, y=Y, t=T, p=P * 255), r"values 0, 255, of which"),
    "a brightness": (archive(x=X, y=Y, t=T, p=X % 90), r"polarity has many different values, 0 to 89; .* --polarity"),
    "x times 32": (
        archive(x=(X * 32).astype("u2"), y=(Y * 32).astype("u2"), t=T, p=P),
        r"x and y reach 20448 and are multiples of 32, .* --scale-xy 32",
    ),
    "fractions of 1/32": (
        archive(x=(X * 32 + 1).astype("u2"), y=(Y * 32 + 1).astype("u2"), t=T, p=P),
        r"x and y reach 20449 and 15329, more than any sensor has; .*--scale-xy",
    ),
    "sorted by pixel": (
        lines(sorted(zip(SECONDS, X, Y, P, strict=True), key=lambda row: row[1])),
        r"of 1000 events are out of order; .* --sort",
    ),
    "milliseconds or seconds": (
        lines(zip(T / 7, X, Y, P, strict=True), separator=",", head="t,x,y,p\n"),
        r"unit of time is in doubt: times have fractions, .* --time-unit",
    ),
    "nanoseconds since the start": (
        array(np.c_[T * 100_000, X, Y, P]), r"unit of time is in doubt: times are whole numbers, .* --time-unit",
    ),
    "milliseconds since the start": (
        archive(ts=COUNT // 60, xs=COUNT % 640, ys=COUNT % 7, ps=COUNT % 2),
        r"unit of time is in doubt: times are whole numbers, and the first 60,000 events span 999; ",
    ),
    "more events than a sensor sends": (
        archive(ts=COUNT // 59_999, xs=COUNT % 640, ys=COUNT % 7, ps=COUNT % 2),
        r"unit of time is in doubt: times are whole numbers, and the first 60,000 events span 1; ",
    ),
    "three columns": (lines(np.c_[T, X, Y]), r"has 3 columns without names; .* --columns"),
    "five columns": (array(np.c_[T, X, Y, P, P]), r"has 5 columns without names; .* --columns"),
    "no y": (
        lines(np.c_[T, X, P, Y], separator=",", head="t,x,p,z\n"),
        r"no column is named as y; .* t, x, p, z; .*--columns",
    ),
    "two times": (
        lines(np.c_[T, T, X, Y, P], separator=",", head="t,ts,x,y,p\n"), r"columns t and ts can both be t; .*--columns",
    ),
    "two small columns": (array(np.c_[T % 2, P, T % 2, P]), r"order of t, x, y and p is in doubt .* --columns"),
    "names that do not fit": (lines(ROWS, separator=",", head="t,x,y,p,label\n"), r"names 5 columns .* rows have 4"),
    "text as polarity": (archive(xs=X, ys=Y, ts=T, ps=WORDS), r"array ps is <U5; expected integers"),
    "columns of other lengths": (hdf5(x=X, y=Y[:5], t=T, p=P), r"columns of events differ in length"),
    "two sets of columns": (
        hdf5(a__x=X, a__y=Y, a__t=T, a__p=P, b__x=X, b__y=Y, b__t=T, b__p=P),
        r"several sets of columns with events: a, b; .* --columns, such as t=a/t,x=a/x,y=a/y,p=a/p",
    ),
    "fractions of pixels": (array(np.c_[SECONDS, X + 0.5, Y + 0.5, P]), r"is 639\.5; expected whole pixels"),
    "no events": (array(np.zeros((0, 4))), r"holds no events; give another recording"),
    "numbers of 16 bits": (
        array(np.c_[T % 2000, X, Y, P].astype("f2")), r"order of t, x, y and p is in doubt .* --columns",
    ),
    "no numbers": (hdf5(names=np.array([b"a", b"b"])), r"no arrays are named as t, x, y and p"),
    "texts as columns": (parquet(t=["a"], x=["b"], y=["c"], p=["d"]), r"no arrays are named as t, x, y and p"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_doubt_names_the_option(tmp_path: Path, name: str) -> None:
    maker, message = REFUSED[name]
    with pytest.raises(AmiwarpError, match=rf"(?s)events: .*{message}"):
        open_recording(made(tmp_path, maker))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": "t=ts,x=xs"}, "does not name t, x, y and p once each"),
        ({"columns": "x,y,t"}, "does not name t, x, y and p once each"),
        ({"columns": "t=y,t=t,x=x,y=y,p=p"}, "does not name t, x, y and p once each"),
        ({"columns": "t,x,y,p,p"}, "does not name t, x, y and p once each"),
        (
            {"columns": "t=a,x=b,y=c,p=d"},
            "has no column 'a', which --columns gives for t; it has t, x, y, p",
        ),
        ({"time_unit": "h"}, "--time-unit 'h' is unknown; choose among s, ms, us, ns"),
        ({"polarity": "1=yes"}, "--polarity '1=yes' is not a list of values"),
        (
            {"polarity": "3=on,4=off"},
            "line 2 is '191,639,479,0'; expected 't x y p' with t in us, p 3 or 4",
        ),
        ({"scale_xy": 0}, "--scale-xy = 0 is not a whole number"),
        ({"size": 640}, "size is 640; give the width and the height"),
        ({"size": (640, 0)}, "height of size"),
        ({"scale_xy": 32}, "no multiple of 32; give another --scale-xy"),
        ({"chip": "DVS128"}, "needs no chip; leave out --chip"),
        ({"size": (320, 240)}, r"lie outside the 320x240 frame"),
    ],
)
def test_options_that_do_not_fit(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        open_recording(made(tmp_path, LAYOUTS["csv with names"][0]), **options)


def test_options_for_other_formats(tmp_path: Path) -> None:
    write_raw_of_a_sensor(tmp_path / "a.raw", "plugin_name hal_plugin_genx320")
    with pytest.raises(
        AmiwarpError, match=r"evt, whose layout is fixed; leave out --time-unit, --polarity"
    ):
        open_recording(tmp_path / "a.raw", time_unit="s", polarity="1=on,0=off")
    convert(tmp_path / "a.raw", tmp_path / "a.h5")
    with pytest.raises(
        AmiwarpError, match=r"amiwarp's own format, whose layout is fixed; leave out --columns"
    ):
        open_recording(tmp_path / "a.h5", columns="t,x,y,p")


@pytest.mark.parametrize(
    ("line", "size"),
    [
        ("plugin_name hal_plugin_genx320", (320, 320)),
        ("sensor_name IMX636", (1280, 720)),
        ("sensor_name Gen3.1", (640, 480)),
        ("plugin_name hal_plugin_imx646_evk4", (1280, 720)),
        # Without the name of a sensor, the smallest one that holds the event
        (
            "generation 4.1",
            (128, 128),
        ),
    ],
)
def test_sizes_of_raw_files_without_a_geometry(
    tmp_path: Path, line: str, size: tuple[int, int]
) -> None:
    write_raw_of_a_sensor(tmp_path / "a.raw", line)
    recording = open_recording(tmp_path / "a.raw")
    assert recording.events.size == size
    assert ("assumed_size" in recording.metadata) == (size == (128, 128))


def test_what_is_assumed_is_said(tmp_path: Path) -> None:
    recording = open_recording(made(tmp_path, array(np.c_[X, Y, P * 0 + 1, T])))
    assert recording.metadata["columns"] == "t = column 4, x = column 1, y = column 2, p = column 3"
    assert recording.metadata["time_unit"] == "us"
    found = [(each.what, each.value, each.option) for each in assumptions_of(recording.metadata)]
    assert found == [
        ("columns", "x y p t", "--columns"),
        ("time unit", "us", "--time-unit"),
        ("polarity", "1 is ON", "--polarity"),
        ("size", "640x480", "--size"),
    ]
    stated = open_recording(
        tmp_path / "events",
        columns="x,y,p,t",
        time_unit="us",
        polarity="1=on,0=off",
        size=(640, 480),
    )
    assert assumptions_of(stated.metadata) == []
    assert stated.metadata["columns"] == recording.metadata["columns"]


def test_a_documented_layout_is_not_assumed(tmp_path: Path) -> None:
    for maker in (
        archive(x=X, y=Y, t=T, p=P, width=640, height=480),
        lines(SECOND_ROWS, head="640 480\n"),
    ):
        recording = open_recording(made(tmp_path, maker))
        assert set(recording.metadata) == {"format"}


def test_times_since_1970(tmp_path: Path) -> None:
    for rest, shift in (
        (499, 0),
        (500, 1),
    ):  # which are rounded exactly, although float64 has steps of 256 ns here
        t = (T + EPOCH) * 1000 + rest
        for maker in (
            archive(xs=X, ys=Y, ts=t, ps=P),
            lines(np.c_[t, X, Y, P]),
            array(np.c_[t, X, Y, P]),
        ):
            recording = open_recording(made(tmp_path, maker))
            assert recording.metadata["time_unit"] == "ns"
            assert_same(recording, EPOCH + shift)
    recording = open_recording(made(tmp_path, lines(np.c_[T + EPOCH, X, Y, P])))
    assert recording.metadata["time_unit"] == "us"
    assert_same(recording, EPOCH)


@pytest.mark.parametrize("kernel_lines", [100, 10_000], ids=["kernel", "NumPy"])
def test_half_a_microsecond_is_rounded_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kernel_lines: int
) -> None:
    monkeypatch.setattr("amiwarp.io.text.reader.KERNEL_LINES", kernel_lines)
    t = np.arange(-3, N - 3) * 1000 + 500
    late = 2**63 - 1 - 1000 * np.arange(N)[::-1]
    for times, expected in ((t, np.arange(-2, N - 2)), (t - 1, np.arange(-3, N - 3))):
        for maker in (lines(np.c_[times, X, Y, P]), archive(x=X, y=Y, t=times.astype(float), p=P),
                      archive(x=X, y=Y, t=times, p=P)):  # fmt: skip
            np.testing.assert_array_equal(
                of(open_recording(made(tmp_path, maker), time_unit="ns")).t, expected
            )
    path = made(tmp_path, archive(x=X, y=Y, t=late, p=P))
    np.testing.assert_array_equal(of(open_recording(path, time_unit="ns")).t, late // 1000 + 1)


def test_long_recordings_need_their_unit(tmp_path: Path) -> None:
    """The first events may look plausible."""
    t = np.concatenate([np.arange(70_000), [3600 * 10**6 + 1]])
    rows = np.c_[t, t % 600, t % 400, t % 2]
    path = made(tmp_path, archive(rows))
    with pytest.raises(
        AmiwarpError, match=r"in us, the recording would last 3,600 s; give it with --time-unit"
    ):
        open_recording(path)
    assert open_recording(path, time_unit="us").events.t_last == t[-1]


def test_openmv(tmp_path: Path) -> None:
    kinds = P.copy()
    kinds[[3, 700]] = 4  # an edge of the trigger
    recording = open_recording(made(tmp_path, archive(data=openmv(kinds))))
    events, kept = of(recording), kinds <= 1
    for name, expected in (("x", X // 2), ("y", Y * 2 // 3), ("t", T + 2_345_000), ("p", P)):
        np.testing.assert_array_equal(getattr(events, name), expected[kept], err_msg=name)
    assert (recording.events.size, recording.metadata["other_records"]) == ((320, 320), 2)
    assert assumptions_of(recording.metadata)[0].value == "type s ms us x y"


@pytest.mark.parametrize(
    "head", ["", "t,x,y,p\r", "# recorded\r"], ids=["values", "names", "a comment"]
)
def test_lines_must_end_with_a_newline(tmp_path: Path, head: str) -> None:
    path = made(tmp_path, lines(ROWS, separator=",", head=head, end="\r"))
    with pytest.raises(
        AmiwarpError, match=r"events: line 1 holds a carriage return; lines must end with a newline"
    ):
        open_recording(path)


def test_text_has_no_columns_of_openmv(tmp_path: Path) -> None:
    path = made(tmp_path, lines(openmv(P)))
    with pytest.raises(
        AmiwarpError, match=r"has 6 columns without names; say which are which with --columns"
    ):
        open_recording(path)


def test_events_in_the_order_of_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order = np.lexsort((T, X))
    path = made(tmp_path, lines(np.c_[T, X, Y, P][order], separator=",", head="t,x,y,p\n"))
    recording = open_recording(path, sort=True)
    expected = np.argsort(T[order], kind="stable")
    events = of(recording)
    np.testing.assert_array_equal(events.t, T)
    np.testing.assert_array_equal(events.x, X[order][expected])
    np.testing.assert_array_equal(events.y, Y[order][expected])
    assert recording.metadata["sorted_events"] == np.count_nonzero(expected != np.arange(N))
    assert "repaired_time_events" not in recording.metadata
    monkeypatch.setattr("amiwarp.io.event_order.SORT_EVENTS", N - 1)
    with pytest.raises(
        AmiwarpError, match=r"events: after 1000 events: holds over 999 events, too many to sort"
    ):
        open_recording(path, sort=True)


def test_the_assumed_size_survives_conversion(tmp_path: Path) -> None:
    path = made(tmp_path, lines(SECOND_ROWS))
    summary = convert(path, tmp_path / "a.h5")
    assert summary.assumptions == ("size 640x480 (--size)",)
    copied = open_recording(tmp_path / "a.h5")
    assert not copied.events.size_is_known  # type: ignore[attr-defined]
    assert [each.value for each in assumptions_of(copied.metadata)] == ["640x480"]
    centred = Camera.from_fov(640, 480, 1.0)
    (said,) = size_warnings(Recording(copied.events, camera=centred, metadata=copied.metadata))
    assert "640x480 px is assumed, and the camera's centre with it" in said
    measured = Camera(640, 480, 500.0, 500.0, 310.0, 239.5)
    assert size_warnings(Recording(copied.events, camera=measured, metadata=copied.metadata)) == ()
    stated = open_recording(tmp_path / "a.h5", size=(720, 576))
    assert (stated.events.size, assumptions_of(stated.metadata)) == ((720, 576), [])
    convert(path, tmp_path / "b.h5", size=(640, 512))
    assert assumptions_of(open_recording(tmp_path / "b.h5").metadata) == []
    convert(path, tmp_path / "c.h5", camera=Camera.from_fov(640, 512, 1.0))
    assert assumptions_of(open_recording(tmp_path / "c.h5").metadata) == []


def test_rare_polarities_are_damage(tmp_path: Path) -> None:
    p = P.copy()
    p[500] = 7
    with pytest.raises(
        AmiwarpError,
        match=r"before the first event: a polarity is 7; expected -1, 0, 1; .*--polarity",
    ):
        open_recording(made(tmp_path, archive(x=X, y=Y, t=T, p=p)))
    with pytest.raises(
        AmiwarpError,
        match=rf"line 501 is '{T[500]} {X[500]} {Y[500]} 7'; expected 't x y p' with t in us",
    ):
        open_recording(made(tmp_path, lines(np.c_[T, X, Y, p])))


def test_truth_values_without_a_meaning(tmp_path: Path) -> None:
    path = made(tmp_path, archive(x=X, y=Y, t=T, p=P.astype(bool)))
    with pytest.raises(
        AmiwarpError, match=r"a polarity is 1; expected 0; say what it means with --polarity"
    ):
        open_recording(path, polarity="0=on")
    path = made(tmp_path, archive(x=X, y=Y, t=T, p=np.ones(N, bool)))
    assert not of(open_recording(path, polarity="1=off")).p.any()
    path = made(tmp_path, archive(x=X, y=Y, t=T, p=np.zeros(N, bool)))
    assert of(open_recording(path, polarity="0=on")).p.all()


@pytest.mark.parametrize(
    ("name", "role", "unit"),
    [
        ("t", "t", None), ("ts", "t", None), ("times", "t", None), ("Timestamp", "t", None), ("t_us", "t", "us"),
        ("time [ms]", "t", "ms"), ("timestamp(ns)", "t", "ns"), ("timestampUs", "t", "us"), ("TD/ts", "t", None),
        ("event_t_us", "t", "us"), ("x", "x", None), ("xs", "x", None), ("col", "x", None), ("x_px", "x", None),
        ("row", "y", None), ("polarities", "p", None), ("'Pol'", "p", None), ("on", "p", None),
        ("usec", None, None), ("u", None, None),  # which only count where no column has a usual name
        ("t0", None, None), ("x2", None, None), ("time_offset", None, None), ("exposure_us", None, None),
    ],
)  # fmt: skip
def test_names_of_columns(name: str, role: str | None, unit: str | None) -> None:
    assert role_of(name) == (role, unit)


@pytest.mark.parametrize(
    ("names", "found", "unit"),
    [
        ("usec u v on_off", "t x y p", "us"), ("timestamp_us col row pol", "t x y p", "us"),
        ("ts_ns col row sign", "t x y p", "ns"), ("msec xaddr yaddr polarity_bool", "t x y p", "ms"),
        ("time_in_us pixel_x pixel_y is_positive", "t x y p", "us"), ("nanoseconds x_pos y_pos sgn", "t x y p", "ns"),
        ("id unix_time pos_x pos_y p frame", "- t x y p -", None), ("t x y p u v usec sign", "t x y p - - - -", None),
        ("event_time_ms x-addr y-addr event_pol", "t x y p", "ms"), ("seconds x y p", "t x y p", "s"),
        ("dt x y p", "- x y p", None), ("t x v p", "t x - p", None), ("s x y p", "- x y p", None),
        ("t i j p", "t - - p", None), ("timeUs X Y Polarity", "t x y p", "us"), ("dates x y p", "t x y p", None),
    ],
)  # fmt: skip
def test_roles_of_names(names: str, found: str, unit: str | None) -> None:
    listed, roles = names.split(), roles_of(names.split())
    at = {place: role for role, places in roles.items() for place in places}
    assert [at.get(place, "-") for place in range(len(listed))] == found.split()
    assert (
        next(
            (
                unit_in(name)
                for name, role in zip(listed, found.split(), strict=True)
                if role == "t"
            ),
            None,
        )
        == unit
    )


def test_rows_across_groups_of_parquet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pq.ParquetWriter(tmp_path / "a.parquet", pa.schema([("t", pa.int64())])) as writer:
        for start, stop in ((0, 3), (3, 4), (4, 4), (4, 9)):
            writer.write_table(pa.table({"t": np.arange(start, stop)}))
    column = parquet_arrays.parquet_arrays(str(tmp_path / "a.parquet"))["t"]
    assert column.shape == (9,)
    for start in range(9):
        for stop in range(start + 1, 10):
            np.testing.assert_array_equal(column[start:stop], np.arange(start, stop), strict=True)
    read: list[int] = []
    rows = parquet_arrays._ParquetColumn._rows

    def noted(self: Any, group: int) -> Any:
        read.append(group)
        return rows(self, group)

    monkeypatch.setattr(parquet_arrays._ParquetColumn, "_rows", noted)
    for start, stop, groups in ((0, 3, [0]), (3, 4, [1]), (2, 5, [0, 1, 2, 3]), (4, 9, [3])):
        read.clear()
        column[start:stop]
        assert read == groups


def test_real_matlab_file(data_dir: Path) -> None:
    path = data_dir / "text/shapes_rotation/shapes_rotation_first_1.43s.mat"
    recording = open_recording(path)
    t, x, y, p = loadmat(path, simplify_cells=True)["events"]["e_data"]
    events = of(recording)
    assert (recording.events.size, len(events)) == ((240, 180), 120_000)
    for name, expected in (("t", np.rint(t * 1e6)), ("x", x), ("y", y), ("p", p)):
        np.testing.assert_array_equal(getattr(events, name), expected, err_msg=name)


MAKERS: dict[str, Callable[[Any], Maker]] = {
    "npz": lambda t: archive(x=X[: len(t)], y=Y[: len(t)], t=t, p=P[: len(t)]),
    "npy": lambda t: array(
        np.rec.fromarrays([t, X[: len(t)], Y[: len(t)], P[: len(t)]], names="t,x,y,p").view(
            np.ndarray
        )
    ),
    "csv": lambda t: lines(
        np.c_[t, X[: len(t)], Y[: len(t)], P[: len(t)]], separator=",", head="t,x,y,p\n"
    ),
    "HDF5": lambda t: hdf5(
        events__x=X[: len(t)], events__y=Y[: len(t)], events__t=t, events__p=P[: len(t)]
    ),
}
"""Layouts with times in microseconds by the promise of the format, and a table without such a promise."""


@pytest.mark.parametrize("layout", MAKERS)
def test_times_in_another_unit_than_the_layout_has(tmp_path: Path, layout: str) -> None:
    """Nanoseconds since 1970 are read and said; what may be milliseconds or seconds is refused."""
    of_layout = MAKERS[layout]
    recording = open_recording(made(tmp_path, of_layout((T + EPOCH) * 1000 + 400)))
    assert_same(recording, EPOCH)
    (said,) = (each for each in assumptions_of(recording.metadata) if each.what == "time unit")
    assert (said.value, said.option) == ("ns", "--time-unit")
    for divisor, unit, given in ((1000, "milliseconds", "ms"), (1_000_000, "seconds", "s")):
        t = (T * 30 + EPOCH) // divisor
        path = made(tmp_path, of_layout(t))
        with pytest.raises(
            AmiwarpError,
            match=rf"from {t[0]} may be {unit} since 1970, .* --time-unit {given} or us",
        ):
            open_recording(path)
        assert open_recording(path, time_unit=given).events.t_first == t[0] * divisor
        assert open_recording(path, time_unit="us").events.t_first == t[0]


def test_a_rate_that_no_camera_has(tmp_path: Path) -> None:
    t = COUNT // 30_000
    for maker in (archive(x=COUNT % 640, y=COUNT % 7, t=t, p=COUNT % 2),
                  hdf5(events__x=COUNT % 640, events__y=COUNT % 7, events__t=t, events__p=COUNT % 2)):  # fmt: skip
        path = made(tmp_path, maker)
        with pytest.raises(
            AmiwarpError, match=r"the first 60,000 events span 1; give it with --time-unit"
        ):
            open_recording(path)
        assert open_recording(path, time_unit="ms").events.t_last == 1000
    with h5py.File(
        path, "r+"
    ) as file:  # as in DSEC's files, whose times are known to be microseconds
        file["ms_to_idx"] = np.zeros(1, np.uint64)
    assert open_recording(path).events.t_last == 1


@pytest.mark.parametrize("unit", ["us", "ns"])
def test_options_keep_the_offset_of_times(tmp_path: Path, unit: str) -> None:
    """Files of DSEC's layout count from ``t_offset``, also where an option or the polarity has another reader."""
    factor = {"us": 1, "ns": 1000}[unit]
    path = made(tmp_path, hdf5(events__x=X, events__y=Y, events__t=(T * factor).astype("u4"), events__p=P,
                               t_offset=np.int64(EPOCH * factor)))  # fmt: skip
    assert_same(open_recording(path, time_unit=unit), EPOCH)
    if unit == "us":
        assert_same(open_recording(path), EPOCH)
        assert_same(open_recording(path, polarity="1=on,0=off"), EPOCH)


def test_times_of_own_files_are_believed(tmp_path: Path) -> None:
    """A camera that has run for weeks has times that could be milliseconds since 1970, too."""
    t = T + 1_700_000_000_000
    whole = Events.from_arrays(X, Y, t, P)
    for name in ("a.npz", "a.h5", "dsec.h5"):
        form = "dsec" if name == "dsec.h5" else None
        save = tmp_path / "source.h5"
        save_recording(save, Recording(MemoryEvents(whole, 640, 480)), overwrite=True)
        convert(save, tmp_path / name, format=form)
        np.testing.assert_array_equal(of(open_recording(tmp_path / name)).t, t)


@pytest.mark.parametrize("head", ["", "t,x,y,p\n"], ids=["without names", "with names"])
@pytest.mark.parametrize(
    ("separator", "zone", "hours"),
    [("T", "", 0), (" ", "", 0), ("T", "Z", 0), ("T", "+02:00", 2), (" ", "-0330", -3.5)],
)
def test_times_may_be_dates(
    tmp_path: Path, head: str, separator: str, zone: str, hours: float
) -> None:
    recording = open_recording(
        made(tmp_path, lines(dates(separator, zone, hours=hours), separator=",", head=head))
    )
    assert_same(recording, START_US)
    assert recording.metadata["time_zone"] == "UTC, unless a time states another zone"
    assert not [each for each in assumptions_of(recording.metadata) if each.what == "time unit"]
    with pytest.raises(AmiwarpError, match="times are dates, but --time-unit is ms; leave it out"):
        open_recording(tmp_path / "events", time_unit="ms")


def test_dates_beside_the_times(tmp_path: Path) -> None:
    rows = [(stamp, t, *rest) for (stamp, *rest), t in zip(dates(), T.tolist(), strict=True)]
    recording = open_recording(
        made(tmp_path, lines(rows, separator=",", head="datetime,t_us,x,y,p\n"))
    )
    assert_same(recording)
    assert "time_zone" not in recording.metadata
    recording = open_recording(tmp_path / "events", columns="t=datetime,x=x,y=y,p=p")
    assert_same(recording, START_US)


def test_dates_in_nanoseconds_are_rounded(tmp_path: Path) -> None:
    rows = [
        (f"{stamp}{rest}", *others)
        for (stamp, *others), rest in zip(dates(), ["499", "500"] * N, strict=False)
    ]
    found = of(open_recording(made(tmp_path, lines(rows, separator=";", head="time_ns;x;y;p\n"))))
    np.testing.assert_array_equal(found.t, np.maximum.accumulate(T + START_US + np.arange(N) % 2))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize(
    "cut", ["0.2", "0.2 3", "0.200000 3 4", "0.200000 3 4 -", "0.200000 3 4 1 7"]
)
def test_a_last_line_that_is_cut_off_is_dropped(tmp_path: Path, encoding: str, cut: str) -> None:
    path = made(tmp_path, lines(SECOND_ROWS, end="\n"))
    path.write_bytes((path.read_text() + cut).encode(encoding))
    recording = open_recording(path)
    assert_same(recording)
    assert recording.metadata["truncated_bytes"] == len(cut)
    path.write_bytes((path.read_text(encoding) + "\n").encode(encoding))
    with pytest.raises(AmiwarpError, match=rf"line 1001 is '{cut}'"):
        open_recording(path)


@pytest.mark.parametrize("between", ["# end\n", "\n", "% a remark\n\n"])
def test_comments_before_a_last_line_do_not_count(tmp_path: Path, between: str) -> None:
    path = tmp_path / "a.txt"
    path.write_text(f"0.1 1 2 1\n0.2 3 4 0\n{between}0.3 5 6 1")
    recording = open_recording(path)
    assert (len(recording.events), "truncated_bytes" in recording.metadata) == (3, False)
    path.write_text(f"0.1 1 2 1\n0.2 3 4 0\n{between}0.3 5")
    recording = open_recording(path)
    assert (len(recording.events), recording.metadata["truncated_bytes"]) == (2, 5)
    path.write_text("0.1 1 2 1\n0.2 3 4 0\n# end")
    recording = open_recording(path)
    assert (len(recording.events), "truncated_bytes" in recording.metadata) == (2, False)


def test_a_time_that_lost_digits_is_cut_off(tmp_path: Path) -> None:
    """Neither is it the last time, which is read from the end of a large file."""
    path = made(tmp_path, lines(np.c_[X, Y, P, T]))
    text = path.read_text().rstrip("\n")
    path.write_text(text)
    recording = open_recording(path)
    assert_same(recording)
    assert "truncated_bytes" not in recording.metadata
    assert recording.events.last_time() == T[-1]
    path.write_text(text[:-1])
    recording = open_recording(path)
    assert recording.events.last_time() == recording.events.t_last == T[-2]
    path.write_text(text + "\n# end\n")
    assert open_recording(path).events.last_time() == T[-1]
    path.write_text(text[:-1])
    assert (len(recording.events), recording.metadata["truncated_bytes"]) == (
        N - 1,
        len(text.split("\n")[-1]) - 1,
    )
    path.write_text(text + "\n" + text.split("\n")[-1])
    recording = open_recording(path)
    assert (len(recording.events), "truncated_bytes" in recording.metadata) == (N + 1, False)


def test_a_long_head_in_utf16(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amiwarp.io.text.reader.READ_BYTES", 64)
    text = lines(ROWS, head="# a story\n" * 30 + "t_us\tx\ty\tp\n", separator="\t")
    recording = open_recording(made(tmp_path, in_utf16(text, "utf-16-le", b"\xff\xfe")))
    assert_same(recording)


def test_an_empty_value_does_not_shift_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An empty value and one too many are not those of a sound row, for the kernel neither."""
    for kernel_lines in (100, 10_000):
        monkeypatch.setattr("amiwarp.io.text.reader.KERNEL_LINES", kernel_lines)
        for wrong in (",5,6,1,0", "5,,6,1,0", "5,6,,1,0"):
            rows = [f"{t},{x},{y},{p}" for t, x, y, p in ROWS.tolist()]
            path = tmp_path / "a.csv"
            path.write_text("t,x,y,p\n" + "\n".join([*rows[:500], wrong, *rows[500:]]) + "\n")
            with pytest.raises(AmiwarpError, match=rf"line 502 is '{wrong}'"):
                open_recording(path)


@pytest.mark.parametrize("padding", ["", " ", "  ", "\t", " \t "])
def test_columns_without_use_may_be_empty(tmp_path: Path, padding: str) -> None:
    rows = [f"{t},{x},{y},{p},{padding},3" for t, x, y, p in ROWS.tolist()]
    path = tmp_path / "a.csv"
    path.write_text("t,x,y,p,note,z\n" + "\n".join(rows) + "\n")
    assert_same(open_recording(path))


UNDER_NAMES = {
    "units": ("t,x,y,p\nus,px,px,-\n", "us", True),
    "units in brackets": ("t,x,y,p\n[ms],[px],[px],[-]\n", "ms", True),
    "a unit of the time only": ("t,x,y,p\nns\n", "ns", True),
    "units and none": ("t,x,y,p\nns,,,\n", "ns", True),
    "the unit in the name, too": ("t_us,x,y,p\nus,px,px,-\n", "us", True),
    "Excel's separator": ("sep=,\nt,x,y,p\n", "us", False),
    "Excel's separator, quoted": ('"sep=,"\nt_us,x,y,p\n', "us", True),
    "both": ("\ufeffSEP=,\nt,x,y,p\nus,px,px,-\n", "us", True),
}
"""Lines above the rows, the unit of time, and whether they state it."""


@pytest.mark.parametrize("name", UNDER_NAMES)
def test_lines_of_units_and_separators(tmp_path: Path, name: str) -> None:
    head, unit, is_stated = UNDER_NAMES[name]
    recording = open_recording(made(tmp_path, lines(ROWS, separator=",", head=head)))
    events = of(recording)
    times = {"us": T, "ms": T * 1000, "ns": (T + 500) // 1000}[unit]
    for found, expected in ((events.x, X), (events.y, Y), (events.t, times), (events.p, P)):
        np.testing.assert_array_equal(found, expected)
    assert recording.metadata["time_unit"] == unit
    assert ("assumed_time_unit" in recording.metadata) is not is_stated


@pytest.mark.parametrize(
    ("form", "offset", "options", "note"),
    [
        (
            "{:.5E}",
            123_456_000_000,
            {},
            "to 6 significant digits: steps of 1,000,000 us; export them with all digits",
        ),
        (
            "{:.5g}",
            5_000_000,
            {},
            "to 5 significant digits: steps of 100 us; export them with all digits",
        ),
        (
            "{:.10e}",
            123_456_000_000,
            {},
            "to 11 significant digits: steps of 10 us; export them with all digits",
        ),
        ("{:.11e}", 123_456_000_000, {}, None),
        ("{:.9e}", 1_234_560, {"time_unit": "ms"}, None),
        (
            "{:.5e}",
            123_456,
            {"time_unit": "ms"},
            "to 6 significant digits: steps of 1 ms; export them with all digits",
        ),
        (
            "{:.6e}",
            123_456,
            {"time_unit": "ms"},
            "to 7 significant digits: steps of 0.1 ms; export them with all digits",
        ),
        ("{}", 123_000_000, {}, None),
    ],
)
def test_rounded_times_are_said(
    tmp_path: Path, form: str, offset: int, options: dict[str, Any], note: str | None
) -> None:
    rows = [(form.format(t + offset), *rest) for t, *rest in ROWS.tolist()]
    recording = open_recording(
        made(tmp_path, lines(rows, separator=",", head="t,x,y,p\n")), **options
    )
    assert recording.metadata.get("rounded_times") == note


def test_one_time_with_an_exponent_is_not_rounded(tmp_path: Path) -> None:
    """R writes 100000 as 1e+05 among times with all digits."""
    rows = [
        ("1e+05" if k == 500 else t + 99_000, *rest) for k, (t, *rest) in enumerate(ROWS.tolist())
    ]
    recording = open_recording(made(tmp_path, lines(rows, separator=",", head="t_us,x,y,p\n")))
    assert "rounded_times" not in recording.metadata


@pytest.mark.parametrize("read_bytes", [64, 1 << 22])
def test_a_last_line_without_an_end_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read_bytes: int
) -> None:
    monkeypatch.setattr("amiwarp.io.text.reader.READ_BYTES", read_bytes)
    path = made(tmp_path, lines(ROWS))
    assert "unended_last_lines" not in open_recording(path).metadata
    path.write_text(path.read_text().rstrip("\n"))
    recording = open_recording(path)
    assert_same(recording)
    assert recording.metadata["unended_last_lines"] == 1
    assert convert(path, tmp_path / "a.h5").repairs == {"unended_last_lines": 1}
    path.write_text("5 6 7 1")
    assert "unended_last_lines" not in open_recording(path).metadata


def test_rare_names_are_said(tmp_path: Path) -> None:
    recording = open_recording(made(tmp_path, lines(ROWS, separator=",", head="t_us,u,v,pol\n")))
    said = assumptions_of(recording.metadata)[0]
    assert (said.what, said.value, said.option) == ("columns", "x = u, y = v", "--columns")


def test_a_first_time_may_lack_the_comma(tmp_path: Path) -> None:
    rows = [("0", 0, 0, 1), *COMMAS]
    recording = open_recording(made(tmp_path, lines(rows, separator="\t", head="t_s\tx\ty\tp\n")))
    np.testing.assert_array_equal(of(recording).t, [0, *T])
