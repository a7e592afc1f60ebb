# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""An empty density as the settings and the first view want it, and what to say of it."""
from __future__ import annotations

import numpy as np

from ..errors import FrameError
from ..settings import Settings
from .exact_density import ExactDensity
from .ray_march import Density
from .view import View
from .voxel_density import VoxelDensity

_ALIASED = 0.05  # share of pixels too near for the voxel size that is worth a notice


def new_density(settings: Settings, view: View) -> tuple[Density, str]:
    """
    Return an empty density for the first view, and what to say of it.

    :raises FrameError: if the view has no depth to choose the voxel size from
    """
    s = settings
    if s.density == 'exact':
        return ExactDensity(
            s.pixel_bandwidth, s.depth_bandwidth, s.depth_bandwidth_quadratic), ''
    voxel_size, notice = voxel_size_for(s, view)
    return VoxelDensity(
        s.pixel_bandwidth, s.depth_bandwidth, s.depth_bandwidth_quadratic, voxel_size,
        s.depth_max), notice


def voxel_size_for(settings: Settings, view: View) -> tuple[float, str]:
    """
    Return the voxel size (metres) of a map that begins with a view, and what to say of it.

    :raises FrameError: see new_density
    """
    s = settings
    if s.voxel_size:
        return s.voxel_size, ''
    seen = view.depth[np.isfinite(view.depth)]
    if not len(seen):
        raise FrameError(
            'no_valid_depth', 'the first depth image has no valid depth to choose a '
            'voxel size from; the next one may')
    median = float(np.median(seen))
    voxel_size = s.depth_bandwidth + s.depth_bandwidth_quadratic * median ** 2
    return voxel_size, (
        f'voxel_size is {1000 * voxel_size:.3g} mm: h3 at the first frame\'s median '
        f'depth of {median:.2f} m')


def aliasing(density: Density, view: View) -> str:
    """Return what to say where many pixels are too near for the voxel size."""
    if not isinstance(density, VoxelDensity) or (
            density.aliased_pixels <= _ALIASED * density.pixels):
        return ''
    if not np.isfinite(view.depth).any():
        return ''
    near = float(np.nanpercentile(view.depth, 5))
    fitting = density.finest_voxel(near, view.camera)
    return (
        f'{density.aliased_pixels / density.pixels:.0%} of the pixels are too '
        f'near for voxels of {1000 * density.voxel_size:.3g} mm: detail smaller than that is '
        f'lost there; voxel_size:={_rounded_down(fitting):g} would keep it')


def _rounded_down(value: float) -> float:
    """Return a positive number with two digits, not above it."""
    digit = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(np.floor(value / digit) * digit)
