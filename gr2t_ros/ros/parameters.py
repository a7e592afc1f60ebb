# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The table of settings as a node's parameters."""
from __future__ import annotations

from dataclasses import Field, fields
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from ..settings import Settings

# what rclpy declares or reads itself
_OF_ROS = ('use_sim_time', 'start_type_description_service', 'qos_overrides')


def read_parameters(node: Node) -> Settings:
    """
    Take the values given to a node, and declare all parameters.

    :param node: made with automatically_declare_parameters_from_overrides, so that unknown names
        are seen too
    :raises InputError: for an unknown name, a wrong type or a value out of range
    """
    given = {
        name: parameter.value for name, parameter in node.get_parameters_by_prefix('').items()
        if name.split('.')[0] not in _OF_ROS}
    settings = Settings().updated(given)
    for name in given:
        node.undeclare_parameter(name)
    for item in fields(settings):
        node.declare_parameter(
            item.name, getattr(settings, item.name), _descriptor(item), ignore_override=True)
    return settings


def table(settings: Settings) -> str:
    """Return all values with their units as lines; a star marks those that were changed."""
    lines = []
    for item in fields(settings):
        value = getattr(settings, item.name)
        mark = ' ' if value == item.default else '*'
        lines.append(f' {mark} {item.name} {value!r} {item.metadata["unit"]}'.rstrip())
    return '\n'.join(lines)


def _descriptor(item: Field[Any]) -> ParameterDescriptor:
    meta = item.metadata
    unit = f' [{meta["unit"]}]' if meta['unit'] else ''
    descriptor = ParameterDescriptor(
        name=item.name, description=meta['help'] + unit, read_only=True)
    if meta['choices']:
        descriptor.additional_constraints = f'one of {", ".join(meta["choices"])}'
    if meta['low'] is not None:
        if isinstance(item.default, int):
            descriptor.integer_range = [IntegerRange(
                from_value=int(meta['low']), to_value=int(meta['high']), step=1)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=float(meta['low']), to_value=float(meta['high']), step=0.0)]
    return descriptor
