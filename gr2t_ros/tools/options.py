# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The command line's parameters: presets, ROS parameter files and `-p name:=value`."""
from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml

from ..errors import InputError
from ..settings import Settings
from ..share import share_directory

NODE_NAME = 'gr2t'
_SECTIONS = ('/**', NODE_NAME, f'/{NODE_NAME}')
_OF_EVERY_NODE = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --preset, --params and -p."""
    group = parser.add_argument_group(
        'parameters', 'config/gr2t.yaml in the share folder lists all, with ranges and defaults')
    group.add_argument(
        '--preset', metavar='NAME', help='parameters for a sensor: a file of the share folder '
        'config/, such as tabletop_scan')
    group.add_argument(
        '--params', metavar='FILE', type=Path, help='a ROS 2 parameter file; wins over the preset')
    group.add_argument(
        '-p', metavar='NAME:=VALUE', dest='parameters', action='append', default=[],
        help='one parameter, as in ROS; wins over both; may be repeated')


def settings(args: argparse.Namespace, base: Settings | None = None) -> Settings:
    """
    Return the parameters that the options give.

    :param args: parsed options of add_arguments
    :param base: what holds where they say nothing; None: the defaults
    :raises InputError: for a file, a name or a value that cannot be used
    """
    result = base or Settings()
    if args.preset:
        result = _updated(result, _preset(args.preset))
    if args.params:
        result = _updated(result, args.params)
    return result.updated(_parameters(args.parameters))


def count(text: str) -> int:
    """Return a number of at least 1, as argparse wants to be told of others."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'must be a whole number of at least 1, not {text}')
    return int(text)


def _preset(name: str) -> Path:
    folder = share_directory() / 'config'
    names = sorted(path.stem for path in folder.glob('*.yaml'))
    if name not in names:
        raise InputError(f'there is no preset {name}; known are {", ".join(names)}')
    return folder / f'{name}.yaml'


def _updated(before: Settings, file: Path) -> Settings:
    try:
        return before.updated(_read(file))
    except InputError as error:
        raise InputError(f'{file}: {error}') from error


def _read(file: Path) -> dict[str, object]:
    """Return what a ROS parameter file says to this node."""
    try:
        content = yaml.safe_load(file.read_text(encoding='utf-8'))
    except OSError as error:
        raise InputError(error.strerror or str(error)) from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f'not a YAML file ({" ".join(str(error).split())})') from error
    values: dict[str, object] = {}
    found = False
    for section in _SECTIONS:  # the later are the more special
        node = content.get(section) if isinstance(content, Mapping) else None
        if isinstance(node, Mapping) and isinstance(node.get('ros__parameters'), Mapping):
            values.update(node['ros__parameters'])
            found = True
    if not found:
        raise InputError(
            f'not a ROS parameter file for this node: no {NODE_NAME}: ros__parameters: in it')
    return {str(name): value for name, value in values.items() if name not in _OF_EVERY_NODE}


def _parameters(texts: Sequence[str]) -> dict[str, object]:
    values: dict[str, object] = {}
    for text in texts:
        name, separator, value = text.partition(':=')
        if not separator or not name:
            raise InputError(f'-p {text}: write it as name:=value')
        quoted = value[:1] in ('"', "'") and value[-1:] == value[:1] and len(value) > 1
        values[name] = value[1:-1] if quoted else value
    return values
