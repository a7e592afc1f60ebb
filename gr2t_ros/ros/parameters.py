# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The table of settings as a node's parameters."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, fields
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from ..errors import InputError
from ..settings import Settings, Value

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
        value = _value(getattr(settings, item.name))
        node.declare_parameter(item.name, value, _descriptor(item), ignore_override=True)
    return settings


def changed(settings: Settings, parameters: Sequence[Parameter]) -> Settings:
    """
    Return the settings with what someone asks a running node to change.

    :param parameters: those of ROS itself are passed over
    :raises InputError: if a value cannot be used, or cannot change while the node runs
    """
    known = {item.name: item for item in fields(settings)}
    values = {item.name: item.value for item in parameters if item.name in known}
    new = settings.updated(values)
    for name in values:
        if not known[name].metadata['live'] and getattr(new, name) != getattr(settings, name):
            raise InputError(
                f'parameter {name} is read at the start: restart the node with -p '
                f'{name}:={values[name]}')
    return new


def typed(settings: Settings, parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return parameters with the types that were declared: `3` is good enough for a float."""
    names = {item.name for item in fields(settings) if item.metadata['live']}
    return [
        Parameter(item.name, value=getattr(settings, item.name)) if item.name in names else item
        for item in parameters]


def _value(value: Value) -> bool | int | float | str | list[str]:
    """Return a value as rclpy takes it."""
    return list(value) if isinstance(value, tuple) else value


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
        name=item.name, description=meta['help'] + unit, read_only=not meta['live'])
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
