"""Parameters of the nodes, with descriptors."""

from __future__ import annotations

from typing import Any, NamedTuple

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor


class Parameter(NamedTuple):
    """Parameter of a node. It is read once, when the node starts."""

    name: str
    default: Any
    description: str
    limits: tuple[float, float] | None = None
    """Smallest and largest value of a number."""


def declare(node: Any, parameters: tuple[Parameter, ...]) -> dict[str, Any]:
    """Declare parameters of a node, and return their values by their names."""
    for parameter in parameters:
        descriptor = ParameterDescriptor(description=parameter.description, read_only=True)
        if parameter.limits is not None:
            low, high = parameter.limits
            if isinstance(parameter.default, float):
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
                ]
            else:
                descriptor.integer_range = [
                    IntegerRange(from_value=int(low), to_value=int(high), step=1)
                ]
        node.declare_parameter(parameter.name, parameter.default, descriptor)
    return {parameter.name: node.get_parameter(parameter.name).value for parameter in parameters}
