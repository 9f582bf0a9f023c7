"""Parameters and topics of a node, from the configuration classes of softfin."""

from array import array
from collections.abc import Mapping, Sequence

from pydantic.fields import FieldInfo
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node


def declare(node: Node, fields: Mapping[str, FieldInfo]) -> None:
    """Declare a parameter for each field, with its default and description."""
    for name, field in fields.items():
        default = field.default
        value = list(default) if isinstance(default, tuple) else default
        node.declare_parameter(name, value, ParameterDescriptor(description=field.description))


def read(node: Node, fields: Mapping[str, FieldInfo]) -> dict[str, object]:
    """Return the values of the parameters, keyed by field name."""
    values = {name: node.get_parameter(name).value for name in fields}
    return {
        name: value.tolist() if isinstance(value, array) else value
        for name, value in values.items()
    }


def resolve(node: Node, names: Sequence[str]) -> dict[str, str]:
    """Return the topics in the namespace of the node, after remapping, keyed by field name of the
    configuration, such as ``wrench_topic``."""
    return {f"{name}_topic": node.resolve_topic_name(name) for name in names}
