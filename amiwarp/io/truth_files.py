"""Export of ground truth to the formats of public data sets: optical flow for DSEC and MVSEC, poses for TUM.

``docs/reference/recording-format.md`` describes the conventions.
"""

from __future__ import annotations

import contextlib
import io
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

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.poses import Poses, PoseStore
from amiwarp.events.truth import FrameStore, FrameTruth
from amiwarp.io.numpy_arrays import write_array
from amiwarp.io.output_formats import POSE_ENDINGS, check_ending, make_folder
from amiwarp.io.outputs import NewFile
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress
from amiwarp.validation import instance, shown

DSEC_SCALE = 128.0
"""Levels per pixel of displacement in DSEC's flow pictures."""

DSEC_ZERO = 1 << 15
"""Level of displacement 0 in DSEC's flow pictures."""

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
    """Write displacements in the DSEC format: folders ``forward`` and ``backward``, and the times of both.

    Parameters
    ----------
    folder : str or path-like
        Folder to write to, which is created if necessary.
    frames : FrameStore
        Ground truth of at least two instants.
    with_prism : bool, default False
        Whether to write the displacements that the pixels see through the turning prism.
    overwrite : bool, default False
        Whether existing files may be replaced.
    progress : callable, optional
        Function that is called with the name of the present step and the finished fraction.

    Returns
    -------
    int
        Number of written pictures in each direction: one per interval between two instants.

    Raises
    ------
    AmiwarpError
        If there are fewer than two instants, or a file cannot be written.

    Notes
    -----
    A picture has three channels of 16 bits: x and y displacement, each times 128 plus 2¹⁵, and 1 for known pixels.
    Displacements of 256 px and more do not fit into the format and count as unknown. A picture is numbered by the
    instant at which its pixels see: ``forward/000000.png`` leads from the first instant to the second, and
    ``backward/000001.png`` from the second to the first. ``forward_timestamps.txt`` and ``backward_timestamps.txt``
    have the two times of each picture [us]. DSEC has no occlusion: ``occlusion/000000.png`` ... and
    ``backward_occlusion/000001.png`` ... hold :attr:`FrameTruth.occlusion` and :attr:`FrameTruth.backward_occlusion`
    with 8 bits.

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
    for name in ("forward", "occlusion", "backward", "backward_occlusion"):
        make_folder(folder / name)
    head = "# from_timestamp_us, to_timestamp_us"
    forward_times = [head]
    backward_times = [head]
    # Either all files appear at the end, or no file.
    with contextlib.ExitStack() as files:

        def write(name: str, content: bytes) -> None:
            part = files.enter_context(NewFile(folder / name, overwrite=overwrite)).part
            part.write_bytes(content)

        for index, frame in enumerate(frames):
            picture = f"{index:06d}.png"
            if index < len(intervals):
                start, stop = intervals[index]
                moved, occlusion = _displacement(frame, with_prism=with_prism)
                write(f"forward/{picture}", encode_png16(dsec_picture(moved)))
                write(f"occlusion/{picture}", _encode_png8(occlusion))
                forward_times.append(f"{start}, {stop}")
            if index > 0:
                start, stop = intervals[index - 1]
                moved, occlusion = _backward(frame, with_prism=with_prism)
                write(f"backward/{picture}", encode_png16(dsec_picture(moved)))
                write(f"backward_occlusion/{picture}", _encode_png8(occlusion))
                backward_times.append(f"{stop}, {start}")
            if progress is not None:
                progress("writing flow", (index + 1) / len(frames))
        write("forward_timestamps.txt", _text(forward_times))
        write("backward_timestamps.txt", _text(backward_times))
    return len(intervals)


def _text(lines: list[str]) -> bytes:
    """Return lines as the content of a text file."""
    return ("\n".join(lines) + "\n").encode("ascii")


@guarded
def save_flow_mvsec(
    path: str | os.PathLike[str],
    frames: FrameStore,
    *,
    with_prism: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write displacements in the MVSEC format: ``timestamps``, ``x_flow_dist``, ``y_flow_dist`` in a .npz file.

    Parameters
    ----------
    path : str or path-like
        File to write, with the suffix .npz.
    frames : FrameStore
        Ground truth of at least two instants.
    with_prism : bool, default False
        Whether to write the displacements that the pixels see through the turning prism.
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
    from an instant to the next. Unknown pixels, and all of the last instant, hold 0, which evaluations on MVSEC ignore.
    The array ``occlusion`` holds :attr:`FrameTruth.occlusion`.

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
    count = len(intervals) + 1
    with (
        NewFile(path, overwrite=overwrite) as new,
        zipfile.ZipFile(new.part, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        seconds = np.asarray(frames.t, np.float64) * 1e-6
        stored = seconds.astype("<f8").tobytes()
        write_array(archive, "timestamps", seconds.shape, "<f8", [stored])
        height, width = frames[0].depth.shape
        for axis, name in enumerate(("x_flow_dist", "y_flow_dist")):

            def maps(axis: int = axis) -> Iterator[bytes]:
                for index in range(count):
                    moved, _ = _displacement(frames[index], with_prism=with_prism)
                    known = np.isfinite(moved).all(axis=2)
                    yield np.where(known, moved[..., axis], 0.0).astype("<f4").tobytes()
                    if progress is not None:
                        progress("writing flow", (axis + (index + 1) / count) / 2.0)

            write_array(archive, name, (count, height, width), "<f4", maps())

        def occlusions() -> Iterator[bytes]:
            for index in range(count):
                _, occlusion = _displacement(frames[index], with_prism=with_prism)
                yield occlusion.tobytes()

        write_array(archive, "occlusion", (count, height, width), "|u1", occlusions())
    return count


@guarded
def save_poses_tum(
    path: str | os.PathLike[str],
    poses: PoseStore,
    *,
    body: str | None = None,
    overwrite: bool = False,
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
    # An array of numbers can be sliced too, but is no store of poses.
    given: Any = poses
    none_of_them = None if isinstance(given, np.ndarray) else given[:0]
    known = sorted(instance(none_of_them, Poses, "poses[:0]").bodies)
    if body is not None and not (isinstance(body, str) and body in known):
        raise AmiwarpError(
            f"body {shown(body)} has no poses; choose among {', '.join(known) or 'none: no body moves'}",
            ErrorCode.CONTENT_MISSING,
        )
    with (
        NewFile(path, overwrite=overwrite) as new,
        open(new.part, "w", encoding="ascii", newline="\n") as file,
    ):
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for start in range(0, len(poses), POSE_ROWS):
            block = poses[start : start + POSE_ROWS]
            rows = block.camera if body is None else block.bodies[body]
            for t, row in zip(block.t, rows, strict=True):
                numbers = " ".join(f"{value:.9g}" for value in row)
                file.write(f"{int(t) * 1e-6:.6f} {numbers}\n")


def _intervals(frames: FrameStore) -> list[tuple[int, int]]:
    """Return the intervals between instants [us]; raise :class:`AmiwarpError` if there are fewer than two instants."""
    t = [int(time) for time in frames.t]
    if len(t) < 2:
        raise AmiwarpError(
            f"flow needs ground truth of two instants, but there are {len(t)}; simulate with --truth-hz",
            ErrorCode.CONTENT_MISSING,
        )
    return list(itertools.pairwise(t))


def _displacement(
    frame: FrameTruth, *, with_prism: bool
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the displacement to the next instant [px], shape (height, width, 2), and the occlusion of the points."""
    if with_prism:
        return frame.displacement_with_prism, frame.occlusion_with_prism
    return frame.displacement, frame.occlusion


def _backward(
    frame: FrameTruth, *, with_prism: bool
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the displacement to the instant before [px], shape (height, width, 2), and the occlusion of the points."""
    if with_prism:
        return frame.backward_with_prism, frame.backward_occlusion_with_prism
    return frame.backward, frame.backward_occlusion


def dsec_picture(displacement: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Encode displacements [px], shape (height, width, 2), as a flow picture of DSEC, shape (height, width, 3)."""
    finite = np.asarray(np.isfinite(displacement).all(axis=2))
    known_displacement = np.where(finite[..., None], displacement, 0.0)
    levels = np.rint(known_displacement * DSEC_SCALE) + DSEC_ZERO
    fits = np.asarray(((levels >= 0) & (levels < 1 << 16)).all(axis=2))
    known = (finite & fits)[..., None]
    stored = np.where(known, levels, 0.0)
    return np.concatenate([stored, known], axis=2).astype(np.uint16)


def _encode_png8(picture: NDArray[np.uint8]) -> bytes:
    """Encode a picture of one channel as PNG, in memory: Pillow may not notice a full disk."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG")
    return buffer.getvalue()


def encode_png16(picture: NDArray[np.uint16]) -> bytes:
    """Encode a picture as PNG with three channels of 16 bits, which Pillow cannot write."""
    height, width, _ = picture.shape
    rows = picture.astype(">u2").reshape(height, -1).view(np.uint8)
    # Each row begins with PNG filter type 0
    filters = np.zeros((height, 1), np.uint8)
    lines = np.concatenate([filters, rows], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [
        b"\x89PNG\r\n\x1a\n",
        _png_part(b"IHDR", header),
        _png_part(b"IDAT", zlib.compress(lines.tobytes(), 6)),
        _png_part(b"IEND", b""),
    ]
    return b"".join(parts)


def _png_part(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file: length, kind, data and checksum."""
    length = struct.pack(">I", len(data))
    checksum = struct.pack(">I", zlib.crc32(kind + data))
    return length + kind + data + checksum
