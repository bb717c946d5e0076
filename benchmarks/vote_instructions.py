"""Machine instructions per vote of events sorted by tile, counted in the code for a GPU; needs none.

    python -m benchmarks.vote_instructions [--arch 90] [--nvdisasm PATH] [--out FILE.json]

Compiles the kernel of prepared votes for one GPU architecture, disassembles it with nvdisasm (part of CUDA, or of the
package ``nvidia-cuda-nvdisasm``), and counts the instructions of one pass through its loop over events: the shortest
path on which three candidates vote inside the window. ``peak_gvotes_per_s`` is what an H200 could vote if its 132
multiprocessors issued four instructions in every cycle at 1.98 GHz. ``spills`` counts accesses to local memory on that
path. Writes benchmarks/results/vote_instructions.json.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import warp as wp

from amiwarp.kernels.camera import CameraParams, PinholeParams
from amiwarp.kernels.refraction import CircleParams, ExactParams, RadialCircleParams
from amiwarp.kernels.tiles import AT_ONCE, vote_tiles
from amiwarp.studies.cluster import versions

RESULTS = Path(__file__).parent / "results" / "vote_instructions.json"
MODELS = {"circle": CircleParams, "radial": RadialCircleParams, "exact": ExactParams}
CAMERAS = {"pinhole": PinholeParams, "distorted": CameraParams}
PEAK_PER_S = 132 * 4 * 32 * 1.98e9
"""Instructions of a thread that an H200 issues per second at most."""
FUNCTION = re.compile(r"\.section\s+\.text\.([\w.]+)")
LABEL = re.compile(r"\s*(\.L_x_\d+):")
INSTRUCTION = re.compile(r"\s*/\*[0-9a-f]+\*/\s+(.*?);")
BRANCH = re.compile(r"(@!?U?P\w+\s+)?BRA(?:\.\w+)*\s.*?(\.L_x_\d+)")


@dataclass(frozen=True)
class Code:
    """Instructions of a kernel, and the index of the instruction at each label."""

    instructions: list[str]
    labels: dict[str, int]

    def after(self, k: int) -> list[int]:
        """Return the indices of the instructions that may follow instruction ``k``."""
        text = self.instructions[k]
        if text.startswith("EXIT"):
            return []
        found = BRANCH.match(text)
        if not found:
            return [k + 1] if k + 1 < len(self.instructions) else []
        return [self.labels[found[2]], *([k + 1] if found[1] else [])]

    @cached_property
    def loops(self) -> list[tuple[int, int]]:
        """First and last instruction of each loop."""
        return [(to, k) for k in range(len(self.instructions)) for to in self.after(k) if to <= k and k - to > 1]

    def path(self, first: int, last: int, atomics: int) -> list[int] | None:
        """Return the shortest path with a number of atomic additions from ``first`` to ``last``; no inner loops."""
        best: dict[tuple[int, int], list[int]] = {(first, is_atomic(self.instructions[first])): [first]}
        for k in range(first, last):
            for n in range(atomics + 1):
                way = best.get((k, n))
                for to in self.after(k) if way else []:
                    key = (to, n + is_atomic(self.instructions[to]))
                    if to > k and way and (key not in best or len(best[key]) > len(way) + 1):
                        best[key] = [*way, to]
        return best.get((last, atomics))


def is_atomic(text: str) -> int:
    """Return 1 for an atomic addition to shared or global memory, otherwise 0."""
    return int(bool(re.match(r"(@!?\w+\s+)?(ATOMS|ATOMG|ATOM|RED)\b", text)))


def functions(text: str) -> dict[str, Code]:
    """Return the code of each function in the output of nvdisasm."""
    found: dict[str, Code] = {}
    code = Code([], {})
    for line in text.splitlines():
        if name := FUNCTION.search(line):
            code = found.setdefault(name[1], Code([], {}))
        elif label := LABEL.match(line):
            code.labels[label[1]] = len(code.instructions)
        elif instruction := INSTRUCTION.match(line):
            code.instructions.append(instruction[1].strip())
    return found


def disassembled(kernel: Any, arch: int, nvdisasm: str, folder: Path) -> dict[str, Code]:
    """Compile the module of a kernel, and return the code of its functions."""
    (cubin,) = wp.compile_aot_module(kernel.module, arch=arch, module_dir=folder)
    ran = subprocess.run([nvdisasm, "-c", str(cubin)], capture_output=True, text=True, check=True)
    return functions(ran.stdout)


def row_of(code: Code, path: list[int], votes: int, **about: Any) -> dict[str, Any]:
    """Return the result for one path."""
    taken = [code.instructions[k] for k in path]
    each = len(path) / votes
    return about | {
        "instructions_per_vote": each, "peak_gvotes_per_s": PEAK_PER_S / each / 1e9,
        "loads_of_constants": sum("LDC" in text for text in taken),
        "predicated": sum(text.startswith("@") and "BRA" not in text for text in taken),
        "conversions_and_functions": sum(bool(re.match(r"(@!?\w+\s+)?(MUFU|I2F\b|F2I|I2F\.)", text)) for text in taken),
        "spills": sum(bool(re.search(r"\b(LDL|STL)\b", text)) for text in taken),
    }  # fmt: skip


def sorted_votes(arch: int, nvdisasm: str, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of votes of sorted events."""
    code = disassembled(vote_tiles, arch, nvdisasm, folder)
    for overload in vote_tiles.overloads.values():
        types = {
            label: kind.dtype if wp.types.is_array(kind) else kind for label, kind in overload.adj.arg_types.items()
        }
        of = code[f"{overload.get_mangled_name()}_cuda_kernel_forward"]
        candidates = int(AT_ONCE)
        about = {"kernel": "vote_tiles", "model": _name(MODELS, types["models"]),
                 "camera": _name(CAMERAS, types["camera"]), "candidates": types["motion"].key}  # fmt: skip
        for vote, atomics in (("bilinear", 4 * candidates), ("nearest", candidates)):
            paths = [path for first, last in of.loops if (path := of.path(first, last, atomics))]
            yield row_of(of, min(paths, key=len), candidates, vote=vote, **about)


def _name(structs: dict[str, Any], struct: Any) -> str:
    return next(name for name, one in structs.items() if one is struct)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", type=int, default=90)
    parser.add_argument("--nvdisasm", default="nvdisasm")
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    tool = shutil.which(args.nvdisasm)
    if tool is None:
        parser.error("nvdisasm is not installed; it is part of CUDA and of the package nvidia-cuda-nvdisasm")
    with tempfile.TemporaryDirectory() as name:
        rows = list(sorted_votes(args.arch, tool, Path(name)))
    for row in rows:
        print(json.dumps(row))
    result = {"benchmark": "vote_instructions", "arch": f"sm_{args.arch}", "versions": versions(("warp-lang",)),
              "peak_per_s": PEAK_PER_S, "rows": rows}  # fmt: skip
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
