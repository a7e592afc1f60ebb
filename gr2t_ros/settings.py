# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Every parameter once: name, default, unit, range and help.

The node's declarations and the command line's `-p name:=value` are made from this table. After
changing it, run scripts/write_parameters.py, which writes config/gr2t.yaml and docs/parameters.md.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, Field, field, fields, replace
import difflib
from math import isfinite
import re
from typing import Any

from .errors import InputError

_NAME = re.compile(r'[A-Za-z_]\w*(/[A-Za-z_]\w*)*', re.ASCII)  # of a topic, relative
Value = bool | int | float | str | tuple[str, ...]

# The first parameter of each group, for config/gr2t.yaml and docs/parameters.md.
GROUPS = {
    'pixel_bandwidth': 'The density',
    'start': 'The rays and the meshes',
    'depth_min': 'The input',
    'color_by': 'The output',
}


def _parameter(
    default: Value,
    help: str,  # noqa: A002
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """
    Return a field of the table.

    :param live: whether a running node lets it change
    """
    return field(
        default=default,
        metadata={
            'help': help, 'unit': unit, 'low': low, 'high': high, 'choices': choices,
            'live': live})


@dataclass(frozen=True)
class Settings:
    """All parameters; a value outside its range raises InputError."""

    pixel_bandwidth: float = _parameter(
        1.5, 'Standard deviation h1 = h2 of the kernel across the image.',
        unit='px', low=0.5, high=8.0)
    depth_bandwidth: float = _parameter(
        0.003, 'Standard deviation h3 of the kernel along the depth, at depth 0: about one '
        'standard deviation of the sensor\'s noise.', unit='m', low=1e-5, high=1.0)
    depth_bandwidth_quadratic: float = _parameter(
        0.002, 'Growth of h3 with the square of the depth: h3(z) = depth_bandwidth + this z^2.',
        unit='1/m', low=0.0, high=1.0)

    density: str = _parameter(
        'voxel', 'How the density is kept: sampled on a lattice, at a fixed cost per frame, or '
        'exact, as the reference for short recordings.', choices=('voxel', 'exact'))
    voxel_size: float = _parameter(
        0.0, 'Spacing of the lattice; h3 is never below it. 0: h3 at the median depth of the '
        'first frame.', unit='m', low=0.0, high=1.0)

    start: str = _parameter(
        'robust', 'Where a ray starts: at its observed depth, or (robust) at a neighbour\'s depth '
        'where the observed one is an outlier.', choices=('robust', 'observed'))
    ray_stride: int = _parameter(
        1, 'March every n-th pixel of every n-th row.', unit='px', low=1, high=64)
    min_confidence: float = _parameter(
        0.08, 'Vertices of less confidence are removed: 1 / (1 + sigma / h3), where sigma is the '
        'standard deviation along the ray. What no neighbour and no other view supports has 0.',
        low=0.0, high=1.0, live=True)
    min_edge_likelihood: float = _parameter(
        0.5, 'Edges whose middle has less than this fraction of the larger of their two '
        'vertices\' likelihoods are removed, and those far steeper than the edges around them; '
        '0 keeps all.', low=0.0, high=1.0, live=True)
    keyframe_translation: float = _parameter(
        0.1, 'A frame this far from the last keyframe becomes one, and so owns a mesh.',
        unit='m', low=0.0, high=100.0, live=True)
    keyframe_rotation: float = _parameter(
        0.17, 'A frame turned this far from the last keyframe becomes one.',
        unit='rad', low=0.0, high=3.15, live=True)
    max_keyframes: int = _parameter(
        1000, 'Keyframes kept. Beyond, those too far away to see what the camera sees are '
        'written out, as with max_memory_mb; where there are none, later ones add to the density '
        'only (reported).',
        low=1, high=1_000_000, live=True)
    remarch_budget: float = _parameter(
        0.02, 'Time per frame for marching older rays again, less while images wait in the '
        'node\'s queue; what is left is done when there is time, before a snapshot or at the end.',
        unit='s', low=0.0, high=60.0, live=True)
    max_memory_mb: int = _parameter(
        0, 'Memory of the map (10^6 bytes): blocks, rays and what a snapshot makes of them; the '
        'process takes up to 700 MB besides (gr2t replay, with its picture: 900). Where it is '
        'full, the keyframes farthest from the camera are written out as finished PLY files and '
        'forgotten. 0: half of the machine\'s memory.',
        unit='MB', low=0, high=10_000_000, live=True)
    threads: int = _parameter(
        0, 'Threads that march rays; 0: one per core.', low=0, high=1024)

    depth_min: float = _parameter(
        0.1, 'Depths below are invalid.', unit='m', low=0.0, high=1000.0, live=True)
    depth_max: float = _parameter(
        5.0, 'Depths above are invalid.', unit='m', low=0.0, high=1000.0, live=True)
    world_frame: str = _parameter(
        '', 'Frame the map is built in; empty: the root of the tf tree above the camera, or the '
        'pose topic\'s frame.')
    pose_source: str = _parameter(
        'tf', 'Where camera poses come from: /tf, or a message on the topic `pose`.',
        choices=('tf', 'pose', 'pose_with_covariance', 'odometry', 'transform'))
    max_wait_for_pose: float = _parameter(
        1.0, 'An image that has no pose after this time is dropped, and counted.',
        unit='s', low=0.0, high=60.0)
    time_offset: float = _parameter(
        0.0, 'Added to the stamps of images before their pose is looked up: above 0 where images '
        'are stamped earlier than the poses of the same moment.', unit='s', low=-60.0, high=60.0)
    cameras: tuple[str, ...] = _parameter(
        ('',), 'Names of cameras that build one map, such as [front, rear]: each has topics of '
        'its own below its name. One without a name: the topics are the plain ones.')
    depth_transport: str = _parameter(
        'raw', 'How the depth images come: as depth/image, or compressed as '
        'depth/image/compressedDepth.', choices=('raw', 'compressedDepth'))
    input_qos: str = _parameter(
        'auto', 'Reliability of the subscriptions to images, camera_info and poses; auto: '
        'reliable where all publishers are.', choices=('auto', 'reliable', 'best_effort'))
    use_mask: bool = _parameter(
        False, 'Ignore pixels that are not 0 in the mask on depth/mask, such as those of the '
        'robot itself; the node only.')
    reset_on_time_jump: bool = _parameter(
        False, 'Empty the map when the clock goes back, as where a recording is played in a loop.')
    queue_size: int = _parameter(
        10, 'Images that may wait for the worker; when full the oldest is dropped, and counted.',
        low=1, high=1000)

    color_by: str = _parameter(
        'likelihood', 'What the colours show: the likelihood, or sigma, the standard deviation '
        'along the ray. Blue is doubtful, red is sure.', choices=('likelihood', 'sigma'),
        live=True)
    colour_map: str = _parameter(
        'turbo', 'Colours from doubtful (blue) to sure (red).',
        choices=('turbo', 'jet', 'coolwarm', 'viridis'), live=True)
    publish_rate: float = _parameter(
        2.0, 'Meshes published per second, at most.', unit='Hz', low=0.05, high=60.0, live=True)
    publish_views: bool = _parameter(
        True, 'Whether there are, beside ~/fused_mesh, also the topics ~/mesh and ~/edges: each '
        'keyframe\'s own mesh.')
    display_stride: int = _parameter(
        4, 'The published (not the saved) meshes of keyframes use every n-th ray of every n-th '
        'row.', unit='px', low=1, high=64, live=True)
    shading: bool = _parameter(
        True, 'Faces of the published meshes turned away from a light are darker, since viewers '
        'do not light coloured meshes; the saved ones keep pure colours.', live=True)
    snapshot_directory: str = _parameter(
        '~/gr2t_snapshots', 'Folder of the snapshots (PLY) and maps, which are written nowhere '
        'else; made when needed.')
    snapshot_period: float = _parameter(
        0.0, 'Also save a snapshot so often, where the map has changed; 0: never.',
        unit='s', low=0.0, high=86400.0, live=True)
    snapshot_on_exit: bool = _parameter(
        False, 'Also save a snapshot when the node is told to stop.', live=True)
    map_period: float = _parameter(
        0.0, 'Also save the map so often, where it has changed, and when the node is told to '
        'stop; 0: never.', unit='s', low=0.0, high=86400.0, live=True)
    map_file: str = _parameter(
        '', 'Name of the file in snapshot_directory that ~/load_map reads; empty: the newest map.',
        live=True)

    def __post_init__(self) -> None:
        for item in fields(self):
            _check(item, getattr(self, item.name))
        if self.depth_min >= self.depth_max:
            raise InputError(
                f'parameter depth_min ({self.depth_min:g} m) must be below depth_max '
                f'({self.depth_max:g} m)')

        if not self.cameras or len(set(self.cameras)) < len(self.cameras) or (
                self.cameras != ('',) and not all(map(_NAME.fullmatch, self.cameras))):
            raise InputError(
                f'parameter cameras must hold different names of topics, not {self.cameras!r}')

    def updated(self, values: Mapping[str, object]) -> Settings:
        """
        Return a copy with some values replaced.

        :param values: name -> value, or its text as written in `name:=value`
        :raises InputError: for an unknown name, a wrong type or a value out of range
        """
        known = {item.name: item for item in fields(self)}
        parsed: dict[str, Any] = {}
        for name, value in values.items():
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f'; did you mean {near[0]}?' if near else f'; known: {", ".join(known)}'
                raise InputError(f'unknown parameter {name}{hint}')
            parsed[name] = _parse(known[name], value)
        return replace(self, **parsed)


def parsed(name: str, value: object) -> Value:
    """
    Bring a value, or its text, to a parameter's type; its range is not looked at.

    :param name: of a parameter
    :raises InputError: for a wrong type
    """
    return _parse(Settings.__dataclass_fields__[name], value)


def _parse(item: Field[Any], value: object) -> Value:
    """Bring a value, or its text, to the type of the parameter's default."""
    default: Any = item.default
    kind = type(default)
    text = isinstance(value, str)
    if kind is str and text:
        return str(value)
    if kind is tuple:
        if text:
            value = [name.strip(' "\'') for name in str(value).strip('[] ').split(',')]
        if isinstance(value, Sequence) and all(isinstance(name, str) for name in value):
            return tuple(value) or default
    if kind is bool:
        if isinstance(value, bool):
            return value
        if text and str(value).lower() in ('true', 'false'):
            return str(value).lower() == 'true'
    elif kind in (int, float) and not isinstance(value, bool):
        try:
            number = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            number = float('nan')
        if kind is float and isfinite(number):
            return number
        if kind is int and isfinite(number) and number == int(number):
            return int(number)
    names = {bool: 'true or false', int: 'a whole number', float: 'a number', str: 'a text',
             tuple: 'a list of texts, such as [front, rear]'}
    raise InputError(f'parameter {item.name} must be {names[kind]}, not {value!r}')


def _check(item: Field[Any], value: Any) -> None:
    meta = item.metadata
    if meta['choices'] and value not in meta['choices']:
        raise InputError(
            f'parameter {item.name} must be one of {", ".join(meta["choices"])}, not {value!r}')
    low, high = meta['low'], meta['high']
    if low is not None and not low <= value <= high:
        unit = f' {meta["unit"]}' if meta['unit'] else ''
        raise InputError(
            f'parameter {item.name} must lie in [{low:g}, {high:g}]{unit}, not {value!r}')
