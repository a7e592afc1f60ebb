# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
All that a reconstruction needs to go on, as numbers and columns of rows, and back.

What follows from the rest is left out, and made again: the spline's coefficients, the lattice's
hash, the pixels' rays. A restored reconstruction goes on bit for bit as the saved one would have.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import accumulate
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from ..settings import Settings
from . import blocks as lattice
from .camera import Camera
from .exact_density import ExactDensity
from .ray_march import Density, Rays
from .reconstruction import Keyframe, Reconstruction
from .view import View
from .voxel_density import VoxelDensity

Kind = tuple[str, tuple[int, ...]]  # dtype and shape of a row

ADDING = ('key', 'value', 'expected', 'touched', 'filtered')  # fields of Blocks that views add to
# what the density was begun with: other values would need all views again
FIXED = ('pixel_bandwidth', 'depth_bandwidth', 'depth_bandwidth_quadratic', 'density',
         'voxel_size', 'ray_stride')
_MAX_DEPTH = 1000.0  # metres, of Settings.depth_max
_MAX_DISTANCE = 1e9  # metres, of a camera from the world's origin

_VOXEL: dict[str, Kind] = {
    'block_key': ('<i8', ()), 'block_value': ('<f4', (lattice.VOXELS,)),
    'block_expected': ('<f4', (lattice.VOXELS,)), 'block_touched': ('<i4', ()),
    'block_filtered': ('<i4', ())}
_EXACT: dict[str, Kind] = {
    'view_T_camera_world': ('<f8', (3, 4)), 'view_camera': ('<f8', (14,)),
    'view_layout': ('<i8', (7,)), 'view_factor': ('<f8', ()), 'view_depth': ('<f4', ()),
    'view_precision': ('<f4', ()), 'view_near': ('<f8', ()), 'view_far': ('<f8', ())}
_RAYS: dict[str, Kind] = {
    'pixels': ('<i4', ()), 'start': ('<f4', ()), 'depth': ('<f4', ()), 'total': ('<f4', ()),
    'curvature': ('<f4', ()), 'status': ('|u1', ()), 'iterations': ('|u1', ()),
    'marched': ('<i4', ())}
_KEYFRAME: dict[str, Kind] = {
    'camera': ('<i4', ()), 'T_world_camera': ('<f8', (4, 4)), 'stamp_ns': ('<i8', ()),
    'checked': ('<i8', ()), 'released': ('|u1', ()), 'rays': ('<i8', ()), 'blocks': ('<i8', ())}


def columns_of(density: str) -> dict[str, Kind]:
    """
    Return the name, dtype and row shape of each column.

    :param density: voxel or exact
    """
    return {
        **(_VOXEL if density == 'voxel' else _EXACT),
        **{f'keyframe_{name}': kind for name, kind in _KEYFRAME.items()},
        'keyframe_image': ('<f4', ()), 'keyframe_watched': ('<i4', ()),
        **{f'ray_{name}': kind for name, kind in _RAYS.items()}}


@dataclass(frozen=True)
class State:
    """
    A reconstruction to be written; it must not change meanwhile.

    :param numbers: what JSON can hold
    :param columns: for each of columns_of its rows, in pieces: parts of what is in memory
    """

    numbers: dict[str, Any]
    columns: dict[str, list[NDArray[Any]]]


class Columns(Protocol):
    """Columns that are read piece by piece."""

    def count(self, name: str) -> int:
        """Return the number of rows."""

    def read(self, name: str, begin: int, end: int) -> NDArray[Any]:
        """Return some rows, as an array of its own."""


def state_of(reconstruction: Reconstruction) -> State:
    """
    Return what is to be kept of a reconstruction that has views, or of its copy for ADDING.

    :raises FrameError: if it has none
    """
    density = reconstruction.density
    density.refresh(reconstruction.pool)
    cameras: dict[tuple[Camera, str, str], int] = {}
    keyframes = reconstruction.keyframes
    for keyframe in keyframes:
        cameras.setdefault(_camera_of(keyframe.view), len(cameras))
    heads: dict[str, list[Any]] = {
        'camera': [cameras[_camera_of(item.view)] for item in keyframes],
        'T_world_camera': [item.view.T_world_camera for item in keyframes],
        'stamp_ns': [item.view.stamp_ns for item in keyframes],
        'checked': [item.checked for item in keyframes],
        'released': [item.released for item in keyframes],
        'rays': [len(item.rays.pixels) for item in keyframes],
        'blocks': [0 if item.blocks is None else len(item.blocks) for item in keyframes]}
    numbers, columns = _density_state(density)
    for name, (dtype, shape) in _KEYFRAME.items():
        rows = np.array(heads[name], dtype).reshape(-1, *shape)
        columns[f'keyframe_{name}'] = [rows]
    columns['keyframe_image'] = [item.view.depth.ravel() for item in keyframes]
    columns['keyframe_watched'] = [
        item.blocks for item in keyframes if item.blocks is not None]
    for name in _RAYS:
        columns[f'ray_{name}'] = [getattr(item.rays, name) for item in keyframes]
    return State({
        **numbers, 'settings': asdict(reconstruction.settings), 'views': density.size,
        'stamp_ns': reconstruction.stamp_ns,
        'cameras': [{**asdict(camera), 'name': name, 'frame_id': frame_id}
                    for camera, name, frame_id in cameras]}, columns)


def _camera_of(view: View) -> tuple[Camera, str, str]:
    return view.camera, view.camera_name, view.frame_id


def _density_state(density: Density) -> tuple[dict[str, Any], dict[str, list[NDArray[Any]]]]:
    if isinstance(density, VoxelDensity):
        size = density.blocks.size
        numbers = {
            'voxel_size': density.voxel_size, 'depth_max': density.depth_max,
            'pixels': density.pixels, 'aliased_pixels': density.aliased_pixels,
            'change': density.change}
        columns = {}
        for name in ADDING:
            rows: NDArray[Any] = getattr(density.blocks, name)
            _, shape = _VOXEL[f'block_{name}']
            columns[f'block_{name}'] = [rows.reshape(-1, *shape)[:size]]
        return numbers, columns
    views = density.state.views
    used = density.used
    return {}, {
        f'view_{name}': [getattr(views, name)[:used[name]]] for name in used}


def restore(
    reconstruction: Reconstruction, numbers: Mapping[str, Any], columns: Columns
) -> None:
    """
    Make an empty reconstruction what the saved one was.

    :param reconstruction: its settings have the FIXED ones of the saved; voxel_size may be 0
    :param numbers: of State
    :raises InputError: if the state contradicts itself: kernels would read beyond their arrays
    """
    try:
        cameras = [_camera(item) for item in numbers['cameras']]
        if reconstruction.settings.density == 'voxel':
            density: Density = _voxel_density(reconstruction, numbers, columns)
        else:
            density = _exact_density(reconstruction.settings, numbers, columns)
        reconstruction.restore(
            density, list(_keyframes(density, cameras, columns)), int(numbers['stamp_ns']))
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, FrameError) as error:
        raise InputError(f'its content contradicts itself ({error})') from error


def differing(
    ours: Settings, our_voxel: float, theirs: Settings, their_voxel: float
) -> list[tuple[str, object, object]]:
    """
    Return the name and both values of each of FIXED in which two maps differ.

    :param our_voxel: metres, what voxel_size came to; 0: not known yet, as where it is empty
    """
    found: list[tuple[str, object, object]] = []
    for name in FIXED:
        a, b = getattr(ours, name), getattr(theirs, name)
        if name == 'voxel_size':
            a, b = our_voxel, their_voxel
            if 'exact' in (ours.density, theirs.density) or a == 0:
                continue
        if a != b:
            found.append((name, a, b))
    return found


def _camera(item: Mapping[str, Any]) -> tuple[Camera, str, str]:
    fx, fy, cx, cy = (float(item[name]) for name in ('fx', 'fy', 'cx', 'cy'))
    return Camera(
        int(item['width']), int(item['height']), fx, fy, cx, cy, str(item['model']),
        tuple(map(float, item['distortion']))), str(item['name']), str(item['frame_id'])


def _voxel_density(
    reconstruction: Reconstruction, numbers: Mapping[str, Any], columns: Columns
) -> VoxelDensity:
    settings = reconstruction.settings
    density = VoxelDensity(
        settings.pixel_bandwidth, settings.depth_bandwidth, settings.depth_bandwidth_quadratic,
        float(numbers['voxel_size']), float(numbers['depth_max']))
    size = columns.count('block_key')
    _insist(0 < size < 2 ** 31, 'number of blocks')
    _insist(0 <= int(numbers['change']) < 2 ** 31, 'number of changes')
    blocks = lattice.new_blocks(lattice.capacity_for(size))
    for name in ADDING:
        # one after the other: no more than one of them is in memory twice
        rows = _rows(columns, f'block_{name}', size).ravel()
        getattr(blocks, name)[:len(rows)] = rows
    keys = blocks.key[:size]
    _insist(
        keys[0] == -1 and (keys[1:] >= 0).all() and len(np.unique(keys)) == size, 'blocks')
    density.restore(
        lattice.linked(blocks, size), int(numbers['views']), int(numbers['pixels']),
        int(numbers['aliased_pixels']), int(numbers['change']), reconstruction.pool)
    return density


def _exact_density(
    settings: Settings, numbers: Mapping[str, Any], columns: Columns
) -> ExactDensity:
    density = ExactDensity(
        settings.pixel_bandwidth, settings.depth_bandwidth, settings.depth_bandwidth_quadratic)
    density.restore(int(numbers['views']), {
        name.partition('_')[2]: columns.read(name, 0, columns.count(name)) for name in _EXACT})
    return density


def _keyframes(
    density: Density, cameras: list[tuple[Camera, str, str]], columns: Columns
) -> Iterator[Keyframe]:
    count = columns.count('keyframe_rays')
    heads = {name: _rows(columns, f'keyframe_{name}', count) for name in _KEYFRAME}
    _insist(
        ((heads['camera'] >= 0) & (heads['camera'] < len(cameras))).all(), 'cameras')
    _insist((np.abs(heads['T_world_camera']) < _MAX_DISTANCE).all(), 'poses')
    _insist((heads['rays'] >= 0).all() and (heads['blocks'] >= 0).all(), 'number of rays')
    shapes = [
        (0, 0) if released else (cameras[camera][0].height, cameras[camera][0].width)
        for camera, released in zip(heads['camera'], heads['released'])]
    pixels = [height * width for height, width in shapes]
    rays = _Pieces(columns, [f'ray_{name}' for name in _RAYS], heads['rays'].tolist())
    watched = _Pieces(columns, ['keyframe_watched'], heads['blocks'].tolist())
    images = _Pieces(columns, ['keyframe_image'], pixels)
    for n in range(count):
        camera, name, frame_id = cameras[heads['camera'][n]]
        T_world_camera = heads['T_world_camera'][n].copy()
        depth, = images.read(n)
        view = View(
            depth.reshape(shapes[n]), camera, T_world_camera,
            int(heads['stamp_ns'][n]), name, frame_id)
        found = dict(zip(_RAYS, rays.read(n)))
        steps = np.diff(found['pixels'], prepend=-1, append=pixels[n])
        _insist((steps > 0).all(), 'pixels')
        _insist(((found['start'] > 0) & (found['start'] <= _MAX_DEPTH)).all(), 'depths')
        blocks = None
        if isinstance(density, VoxelDensity):
            blocks, = watched.read(n)
            _insist(((blocks > 0) & (blocks < density.blocks.size)).all(), 'watched blocks')
        yield Keyframe(
            view, Rays(table=camera.rays, T_world_camera=T_world_camera.copy(), **found),
            blocks, int(heads['checked'][n]), released=bool(heads['released'][n]))


class _Pieces:
    """The same rows of several columns, cut into pieces."""

    def __init__(self, columns: Columns, names: list[str], lengths: list[int]) -> None:
        self._columns, self._names = columns, names
        self._ends = [0, *accumulate(lengths)]
        for name in names:
            _insist(columns.count(name) == self._ends[-1], name)

    def read(self, n: int) -> list[NDArray[Any]]:
        """Return the n-th piece of each column."""
        return [self._columns.read(name, *self._ends[n:n + 2]) for name in self._names]


def _rows(columns: Columns, name: str, count: int) -> NDArray[Any]:
    _insist(columns.count(name) == count, name)
    return columns.read(name, 0, count)


def _insist(condition: Any, what: str) -> None:
    if not condition:
        raise ValueError(what)
