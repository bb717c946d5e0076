"""Export of ground truth to the formats of public data sets: optical flow for DSEC and MVSEC, poses for TUM.

``docs/reference/recording-format.md`` describes the conventions.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import FrameStore, Poses, PoseStore
from amiwarp.io.atomic_output import NewFile, make_folder
from amiwarp.io.formats import POSE_ENDINGS, check_ending
from amiwarp.progress import Progress
from amiwarp.validation import guarded, instance, shown

DSEC_SCALE, DSEC_ZERO = 128.0, 1 << 15
"""Encoding of displacements in DSEC's flow pictures: levels per pixel, and the level of displacement 0."""

POSE_ROWS = 1 << 14
"""Number of poses that are read and written at a time."""


@guarded
def save_flow_dsec(
    folder: str | os.PathLike[str],
    frames: FrameStore,
    *,
    with_prism: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write optical flow in the DSEC format: ``forward/000000.png`` ... and ``forward_timestamps.txt``.

    Parameters
    ----------
    folder : str or path-like
        Folder to write to, which is created if necessary.
    frames : FrameStore
        Ground truth of at least two instants.
    with_prism : bool, default False
        Whether to write the flow that the pixels see through the turning prism.
    overwrite : bool, default False
        Whether existing files may be replaced.
    progress : callable, optional
        Function that is called with the name of the present step and the finished fraction.

    Returns
    -------
    int
        Number of written pictures: one per interval between two instants.

    Raises
    ------
    AmiwarpError
        If there are fewer than two instants, or a file cannot be written.

    Notes
    -----
    A picture has three channels of 16 bits: x and y displacement, each times 128 plus 2¹⁵, and 1 for known pixels. The
    displacement over an interval is the flow at the first instant times the length of the interval. Displacements of
    256 px and more do not fit into the format and count as unknown.

    Examples
    --------
    >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> scene = amiwarp.WorldScene(
    ...     amiwarp.World("example", (amiwarp.Body("wall", square),)),
    ...     amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]))
    >>> recording = amiwarp.simulate(
    ...     scene, amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.01), duration_s=0.01, truth_hz=200)
    >>> amiwarp.save_flow_dsec("flow", recording.truth.frames)
    2
    """
    intervals = _intervals(frames)
    folder = Path(folder)
    make_folder(folder / "forward")
    with contextlib.ExitStack() as files:  # either all files appear at the end, or no file
        lines = ["# from_timestamp_us, to_timestamp_us"]
        for index, (start, stop) in enumerate(intervals):
            moved = _displacement(frames, index, stop - start, with_prism=with_prism)
            new = files.enter_context(NewFile(folder / "forward" / f"{index:06d}.png", overwrite=overwrite))
            new.part.write_bytes(encode_png16(dsec_picture(moved)))
            lines.append(f"{start}, {stop}")
            if progress is not None:
                progress("writing flow", (index + 1) / len(intervals))
        new = files.enter_context(NewFile(folder / "forward_timestamps.txt", overwrite=overwrite))
        new.part.write_text("\n".join(lines) + "\n")
    return len(intervals)


@guarded
def save_flow_mvsec(
    path: str | os.PathLike[str],
    frames: FrameStore,
    *,
    with_prism: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write optical flow in the MVSEC format: arrays ``timestamps``, ``x_flow_dist``, ``y_flow_dist`` in a .npz file.

    Parameters
    ----------
    path : str or path-like
        File to write, with the suffix .npz.
    frames : FrameStore
        Ground truth of at least two instants.
    with_prism : bool, default False
        Whether to write the flow that the pixels see through the turning prism.
    overwrite : bool, default False
        Whether an existing file may be replaced.
    progress : callable, optional
        Function that is called with the name of the present step and the finished fraction.

    Returns
    -------
    int
        Number of written flow maps: one per instant.

    Raises
    ------
    AmiwarpError
        If there are fewer than two instants, or the file cannot be written.

    Notes
    -----
    ``timestamps`` are in seconds, shape (k,). The flow maps have shape (k, height, width) and hold displacements [px]
    from an instant to the next: the flow at the instant, times the interval. For the last instant, the last interval is
    used again. Unknown pixels hold 0, which evaluations on MVSEC ignore.

    Examples
    --------
    >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> scene = amiwarp.WorldScene(
    ...     amiwarp.World("example", (amiwarp.Body("wall", square),)),
    ...     amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]))
    >>> recording = amiwarp.simulate(
    ...     scene, amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.01), duration_s=0.01, truth_hz=200)
    >>> amiwarp.save_flow_mvsec("gt_flow_dist.npz", recording.truth.frames)
    3
    """
    path = Path(path)
    check_ending(path, "the flow of MVSEC is written", [".npz"])
    intervals = _intervals(frames)
    lengths = [stop - start for start, stop in intervals]
    lengths.append(lengths[-1])
    with NewFile(path, overwrite=overwrite) as new, zipfile.ZipFile(new.part, "w", zipfile.ZIP_DEFLATED) as archive:
        seconds = np.asarray(frames.t, np.float64) * 1e-6
        _write_array(archive, "timestamps", seconds.shape, seconds.dtype, iter([seconds]))
        height, width = frames[0].depth.shape
        for axis, name in enumerate(("x_flow_dist", "y_flow_dist")):

            def maps(axis: int = axis) -> Iterator[NDArray[np.float32]]:
                for index, length in enumerate(lengths):
                    moved = _displacement(frames, index, length, with_prism=with_prism)
                    known = np.isfinite(moved).all(axis=2)
                    yield np.where(known, moved[..., axis], 0.0).astype(np.float32)
                    if progress is not None:
                        progress("writing flow", (axis + (index + 1) / len(lengths)) / 2.0)

            _write_array(archive, name, (len(lengths), height, width), np.dtype(np.float32), maps())
    return len(lengths)


@guarded
def save_poses_tum(
    path: str | os.PathLike[str], poses: PoseStore, *, body: str | None = None, overwrite: bool = False
) -> None:
    """Write poses to a TUM file: lines of ``timestamp tx ty tz qx qy qz qw``.

    Parameters
    ----------
    path : str or path-like
        File to write, with the suffix .txt or .tum.
    poses : PoseStore
        Poses of the camera and of moving bodies.
    body : str, optional
        Name of the body whose poses are written. By default, the poses of the camera are written.
    overwrite : bool, default False
        Whether an existing file may be replaced.

    Raises
    ------
    AmiwarpError
        If no poses of this body are stored, or the file cannot be written.

    Examples
    --------
    >>> import numpy as np
    >>> poses = amiwarp.Poses(t=np.array([0, 1000]), camera=np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1)))
    >>> amiwarp.save_poses_tum("camera.txt", poses)
    >>> amiwarp.Trajectory.from_file("camera.txt").t.tolist()
    [0.0, 0.001]
    """
    path = Path(path)
    check_ending(path, "poses are written", POSE_ENDINGS)
    given: Any = poses  # an array of numbers can be sliced too
    known = sorted(instance(None if isinstance(given, np.ndarray) else given[:0], Poses, "poses[:0]").bodies)
    if body is not None and not (isinstance(body, str) and body in known):
        raise AmiwarpError(f"body {shown(body)} has no poses; choose among {', '.join(known) or 'none: no body moves'}")
    with NewFile(path, overwrite=overwrite) as new, open(new.part, "w") as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for start in range(0, len(poses), POSE_ROWS):
            block = poses[start : start + POSE_ROWS]
            for t, row in zip(block.t, block.camera if body is None else block.bodies[body], strict=True):
                file.write(f"{int(t) * 1e-6:.6f} " + " ".join(f"{value:.9g}" for value in row) + "\n")


def _intervals(frames: FrameStore) -> list[tuple[int, int]]:
    """Return the intervals between instants [us]; raise :class:`AmiwarpError` if there are fewer than two instants."""
    t = [int(at) for at in frames.t]
    if len(t) < 2:
        raise AmiwarpError(f"flow needs ground truth of two instants, but there are {len(t)}; simulate with --truth-hz")
    return list(itertools.pairwise(t))


def _displacement(frames: FrameStore, index: int, length_us: int, *, with_prism: bool) -> NDArray[np.float64]:
    """Return the displacement [px] of the point that each pixel sees, within ``length_us`` [us].

    The shape is (height, width, 2).
    """
    frame = frames[index]
    return np.asarray((frame.flow_with_prism if with_prism else frame.flow).astype(np.float64) * (length_us * 1e-6))


def dsec_picture(displacement: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Encode displacements [px], shape (height, width, 2), as a flow picture of DSEC, shape (height, width, 3)."""
    known: NDArray[np.bool_] = np.asarray(np.isfinite(displacement).all(axis=2))
    levels = np.rint(np.where(known[..., None], displacement, 0.0) * DSEC_SCALE) + DSEC_ZERO
    known &= np.asarray(((levels >= 0) & (levels < 1 << 16)).all(axis=2))
    levels = np.where(known[..., None], levels, 0.0)
    return np.concatenate([levels, known[..., None]], axis=2).astype(np.uint16)


def encode_png16(picture: NDArray[np.uint16]) -> bytes:
    """Encode a picture as PNG with three channels of 16 bits, which Pillow cannot write."""
    height, width, _ = picture.shape
    rows = picture.astype(">u2").reshape(height, -1).view(np.uint8)
    lines = np.concatenate([np.zeros((height, 1), np.uint8), rows], axis=1)  # each row begins with PNG filter type 0
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_png_part(kind, data) for kind, data in parts)


def _png_part(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file: length, kind, data and checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _write_array(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], parts: Iterator[NDArray[Any]]
) -> None:
    """Write an array to a .npz archive part by part."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        for part in parts:
            file.write(np.ascontiguousarray(part, dtype).tobytes())
