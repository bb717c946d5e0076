"""A small network in a file, for the tests of commands and of public calls."""

from pathlib import Path

import onnx.parser


def write_network(path: Path) -> None:
    """Write an ONNX network that adds up the bins of a voxel grid."""
    text = """<ir_version: 8, opset_import: ["": 18]> sum (float[1,5,h,w] grid) => (float[1,1,h,w] image) {
        axes = Constant <value_ints: ints = [1]> ()
        image = ReduceSum (grid, axes)
    }"""
    onnx.save(onnx.parser.parse_model(text), path)
