# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Two maps of one world become one, since the density is a sum over views.

The exact density is bit for bit that of one run over the views of both, and so are its rays. The
lattice's samples are sums of float32, which were added up in another order: (a1 + a2) + (b1 + b2)
instead of ((a1 + a2) + b1) + b2. Where only one of the maps reaches they are the same bits, and
elsewhere within a rounding, 6e-8 of the value, for each view: all terms are positive.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import InputError
from .exact_density import ExactDensity
from .reconstruction import Keyframe, Reconstruction
from .state import differing
from .voxel_density import VoxelDensity


def add_map(ours: Reconstruction, theirs: Reconstruction) -> None:
    """
    Add the density and the keyframes of another map; rays wait where it changed something.

    :param ours: has views
    :param theirs: likewise, in the same world frame; not to be used any more
    :raises InputError: if the densities are of different kinds, or hold the same views
    """
    a, b = ours.density, theirs.density
    different = differing(ours.settings, getattr(a, 'voxel_size', 0.0),
                          theirs.settings, getattr(b, 'voxel_size', 0.0))
    if different:
        raise InputError('they are of different kinds: ' + ', '.join(
            f'{name} is {first} and {second}' for name, first, second in different))
    known = {_moment(keyframe) for keyframe in ours.keyframes}
    same = [keyframe for keyframe in theirs.keyframes if _moment(keyframe) in known]
    if same:
        raise InputError(
            f'both hold the view of {same[0].view.stamp_ns * 1e-9:.3f} s, as where one went on '
            'from the other: its views would count twice')
    keyframes = theirs.keyframes
    if isinstance(a, VoxelDensity) and isinstance(b, VoxelDensity):
        b.refresh(theirs.pool)
        numbers = np.concatenate([np.zeros(1, np.int32), a.merge(b)])
        keyframes = [
            item if item.blocks is None else replace(item, blocks=numbers[item.blocks])
            for item in keyframes]
    elif isinstance(a, ExactDensity) and isinstance(b, ExactDensity):
        a.merge(b)
        for keyframe in keyframes:
            # its numbers of changes were those of its own map
            keyframe.own_rays().marched[:] = 0
            keyframe.checked = -1
    ours.restore(
        a, [*ours.keyframes, *keyframes], max(ours.stamp_ns, theirs.stamp_ns))


def _moment(keyframe: Keyframe) -> tuple[int, str, bytes]:
    view = keyframe.view
    return view.stamp_ns, view.camera_name, view.T_world_camera.tobytes()
