"""Command ``amiwarp truth``: export of a simulated world's ground truth to the formats of public data sets."""

import re
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from amiwarp.cli.console import progress, report
from amiwarp.cli.options import OUTPUT_FOLDER, Common
from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import Truth
from amiwarp.io import open_recording
from amiwarp.io.export import save_flow_dsec, save_flow_mvsec, save_poses_tum
from amiwarp.io.formats import make_folder

EXAMPLE = "amiwarp truth recording.h5 exported --flow dsec --poses tum"


def run(
    recording: Annotated[Path, typer.Argument(help="Recording of a simulated world, in amiwarp's format (.h5).")],
    out: Annotated[Path, typer.Argument(help="Folder for the exported files."), OUTPUT_FOLDER],
    *,
    flow: Annotated[
        Literal["dsec", "mvsec"] | None,
        typer.Option(
            help="Export optical flow between the recorded instants. dsec: writes 16-bit flow/forward/*.png and "
            "flow/forward_timestamps.txt; mvsec: writes NAME_gt_flow_dist.npz."
        ),
    ] = None,
    with_prism: Annotated[
        bool, typer.Option("--with-prism", help="Export the optical flow as seen through the turning prism.")
    ] = False,
    poses: Annotated[
        Literal["tum"] | None,
        typer.Option(
            help="Export the poses of the camera and the moving bodies. tum: writes poses/camera.txt and "
            "poses/body_NAME.txt."
        ),
    ] = None,
    common: Common,
) -> None:
    """Export the ground truth of a simulated world: optical flow in the DSEC or MVSEC format, poses as TUM files.

    Flow requires a recording that was simulated with --truth-hz.
    """
    began = time.perf_counter()
    if flow is None and poses is None:
        raise AmiwarpError("nothing is chosen to export; give --flow dsec, --flow mvsec or --poses tum")
    source = open_recording(recording)
    truth = source.truth
    if truth is None or (truth.frames is None and truth.poses is None):
        raise AmiwarpError(f"{recording}: holds no ground truth of a world; simulate a recording with --world")
    if flow is not None and truth.frames is None:
        raise AmiwarpError(f"{recording}: holds no optical flow; simulate the recording with --truth-hz")
    make_folder(out)
    data: dict[str, Any] = {"folder": str(out), "flow_maps": 0, "pose_files": 0}
    with progress("writing flow") as advance:
        if truth.frames is not None and flow == "dsec":
            data["flow_maps"] = save_flow_dsec(out / "flow", truth.frames, with_prism=with_prism, progress=advance)
        elif truth.frames is not None and flow == "mvsec":
            path = out / f"{source.name}_gt_flow_dist.npz"
            data["flow_maps"] = save_flow_mvsec(path, truth.frames, with_prism=with_prism, progress=advance)
    if poses is not None:
        data["pose_files"] = _save_poses(out / "poses", truth)
    data["seconds"] = time.perf_counter() - began
    line = f"{out}: {data['flow_maps']} maps of flow, {data['pose_files']} files of poses, {data['seconds']:.2f} s"
    report(common, data, [line])


def _save_poses(folder: Path, truth: Truth) -> int:
    """Write the poses of the camera and of each moving body; return the number of files."""
    if truth.poses is None:
        raise AmiwarpError("the recording holds no poses; simulate a recording with --world")
    make_folder(folder)
    save_poses_tum(folder / "camera.txt", truth.poses)
    names: dict[str, str] = {}
    for body in truth.poses[:0].bodies:
        plain = re.sub(r"[^A-Za-z0-9_.-]", "_", body)[:80]
        name = f"body_{plain}.txt" if f"body_{plain}.txt" not in names else f"body_{plain}_{len(names)}.txt"
        names[name] = body
    for name, body in names.items():
        save_poses_tum(folder / name, truth.poses, body=body)
    return 1 + len(names)
