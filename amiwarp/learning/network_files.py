"""Files of networks, run by PyTorch or onnxruntime."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError, ErrorCode, optional_module
from amiwarp.validation import instance, shown

LARGEST_BYTES = 1 << 32
"""Largest states or output that an ONNX file may declare [bytes]: 20 times the states of E2VID at 1280 x 720 px."""


def as_array(values: Any, device: Any, what: str) -> wp.array:
    """Return an array of any library as a Warp array on the device, without a copy if it is there and has no gaps."""
    try:
        if isinstance(values, wp.array) or (
            hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray)
        ):
            array = values if isinstance(values, wp.array) else wp.from_dlpack(values)
            return array.to(device).contiguous()
        numbers = np.ascontiguousarray(values)
        return wp.array(numbers, dtype=wp.dtype_from_numpy(numbers.dtype), device=device)
    except Exception as error:  # libraries raise many kinds of errors
        raise AmiwarpError(
            f"{what} cannot be read as an array: {cause(error)}; give an array of numbers"
        ) from error


def cause(error: Exception) -> str:
    """Return the line of a library's message that says the most: the last one."""
    return (str(error).strip().splitlines() or [type(error).__name__])[-1].strip().rstrip(".;")


class TorchFile:
    """TorchScript file, run by PyTorch."""

    dtype = wp.float32
    output = ""

    def __init__(self, path: Path, device: Any) -> None:
        torch = optional_module("torch", "torch", f"{path}: a TorchScript file needs PyTorch")
        self.path = path
        self._torch = torch
        if device.is_cuda and not torch.cuda.is_available():
            raise AmiwarpError(
                f"{path}: PyTorch has no CUDA here; install its CUDA version, or give device='cpu'",
                ErrorCode.DEVICE_MISSING,
            )
        try:
            with (
                warnings.catch_warnings()
            ):  # PyTorch recommends other formats, which it cannot read on all versions
                warnings.simplefilter("ignore", DeprecationWarning)
                self._module = torch.jit.load(path, map_location=wp.device_to_torch(device)).eval()
        except Exception as error:  # RuntimeError, ValueError and others
            remedy = (
                "write it by torch.jit.script(network).save(path); weights alone are no network"
            )
            raise AmiwarpError(
                f"{path}: not a TorchScript file: {str(error).partition('.')[0]}; {remedy}",
                ErrorCode.FORMAT_UNKNOWN,
            ) from error
        arguments = self._module.forward.schema.arguments[2:]  # without self and the input
        self.extra = len(arguments)
        self._needed = sum(not argument.has_default_value() for argument in arguments)

    def start(self, first: list[wp.array] | None) -> tuple[Any, ...]:
        """Return the states before the first window."""
        if first is None:
            return (None,) * self._needed
        return tuple(self._torch.from_dlpack(wp.clone(state)) for state in first)

    def run(self, grid: wp.array, states: tuple[Any, ...]) -> tuple[wp.array, tuple[Any, ...]]:
        """Return the first output and the states after a window."""
        with self._torch.no_grad():
            output = self._module(self._torch.from_dlpack(grid), *states)
        outputs = output if isinstance(output, tuple | list) else (output,)
        instance(
            outputs[0] if outputs else None, self._torch.Tensor, f"{self.path}: the first output"
        )
        return wp.from_dlpack(outputs[0].contiguous()), tuple(outputs[1 : 1 + self.extra])


TYPES = {"tensor(float)": wp.float32, "tensor(float16)": wp.float16, "tensor(double)": wp.float64}
"""Types of inputs and outputs, by their names in onnxruntime."""


class OnnxFile:
    """ONNX file, run by onnxruntime."""

    def __init__(self, path: Path, device: Any) -> None:
        onnxruntime = optional_module(
            "onnxruntime", "onnx", f"{path}: an ONNX file needs onnxruntime"
        )
        self.path = path
        self._device = device
        self._place = ("cuda", device.ordinal) if device.is_cuda else ("cpu", 0)
        provider = "CUDAExecutionProvider" if device.is_cuda else "CPUExecutionProvider"
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # errors are raised
        try:
            chosen = [(provider, {"device_id": device.ordinal} if device.is_cuda else {})]
            available = provider in onnxruntime.get_available_providers()
            session = onnxruntime.InferenceSession(
                path, options, chosen if available else ["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime raises many kinds of errors
            raise AmiwarpError(
                f"{path}: not an ONNX file that can be read: {cause(error)}; export it anew",
                ErrorCode.FORMAT_UNKNOWN,
            ) from error
        if provider not in session.get_providers():
            raise AmiwarpError(
                f"{path}: onnxruntime has no CUDA here; install onnxruntime-gpu, or give device='cpu'",
                ErrorCode.DEVICE_MISSING,
            )
        self._session = session
        self._inputs = session.get_inputs()
        self._outputs = [output.name for output in session.get_outputs()]
        self.output = f" '{self._outputs[0]}'"
        self.extra = len(self._inputs) - 1
        if len(self._outputs) <= self.extra:
            raise AmiwarpError(
                f"{path}: has {self.extra} inputs after the first and {len(self._outputs) - 1} outputs after the first"
                "; export the network with one output for each state",
                ErrorCode.FORMAT_UNKNOWN,
            )
        self.dtype = self._type(self._inputs[0].type)
        self._check_sizes("states", self._inputs[1:])
        for output in session.get_outputs():
            self._check_sizes(f"output {output.name}", [output])

    def _check_sizes(self, what: str, declared: Sequence[Any]) -> None:
        """Raise :class:`AmiwarpError` if inputs or outputs take too much memory. Sizes without a number count as 1."""
        size = 0
        for value in declared:
            item = wp.types.type_size_in_bytes(TYPES[value.type]) if value.type in TYPES else 1
            size += item * math.prod(length for length in value.shape if isinstance(length, int))
        if size > LARGEST_BYTES:
            shapes = ", ".join(shown(value.shape) for value in declared[:4])
            raise AmiwarpError(
                f"{self.path}: its {what} of shape {shapes} take {size / 2**30:.4g} GiB; expected at most "
                f"{LARGEST_BYTES >> 30} GiB; the file is damaged, or export the network for smaller images",
                ErrorCode.FILE_DAMAGED,
            )

    def _type(self, name: str) -> Any:
        if name not in TYPES:
            raise AmiwarpError(
                f"{self.path}: has a {name}; expected {', '.join(TYPES)}; export the network so",
                ErrorCode.FORMAT_UNKNOWN,
            )
        return TYPES[name]

    def start(self, first: list[wp.array] | None) -> list[Any]:
        """Return the states before the first window."""
        if first is not None:
            return first
        for wanted in self._inputs[1:]:
            if not all(isinstance(size, int) and size > 0 for size in wanted.shape):
                raise AmiwarpError(
                    f"{self.path}: {wanted.name} has the shape {wanted.shape}; give its first value in states"
                )
        return [
            wp.zeros(state.shape, dtype=self._type(state.type), device=self._device)
            for state in self._inputs[1:]
        ]

    def run(self, grid: wp.array, states: list[Any]) -> tuple[wp.array, list[Any]]:
        """Return the first output and the states after a window."""
        wanted = list(self._inputs[0].shape)
        given = list(grid.shape)
        known = [k for k, size in enumerate(wanted) if isinstance(size, int)]  # others have names
        if len(wanted) != 4 or [wanted[k] for k in known] != [given[k] for k in known]:
            remedy = "multiple" if wanted[:2] == given[:2] else "the bins of the input"
            raise AmiwarpError(
                f"{self.path}: takes inputs of shape {wanted}, not {given}; change {remedy}"
            )
        binding = self._session.io_binding()
        for wanted, value in zip(self._inputs, [grid, *states], strict=True):
            if isinstance(value, wp.array):
                kind = wp.dtype_to_numpy(value.dtype)
                binding.bind_input(wanted.name, *self._place, kind, value.shape, value.ptr)
            else:
                binding.bind_ortvalue_input(wanted.name, value)
        for name in self._outputs:
            binding.bind_output(name, *self._place)
        self._session.run_with_iobinding(binding)
        binding.synchronize_outputs()
        out, *others = binding.get_outputs()
        image = wp.array(
            ptr=out.data_ptr(),
            shape=tuple(out.shape()),
            dtype=self._type(out.data_type()),
            device=self._device,
        )
        image.owner = out  # which keeps the memory
        return image, others[: self.extra]
