# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How well a map of a real recording's even frames predicts the depths of its odd frames.

    python benchmarks/real.py [--data DIR] [--stride 4]

A prediction is where the ray of a pixel first meets the mesh; it does not use the odd frame's
depths. Beside it, where it is installed, Open3D's TSDF (weight >= 3) of the same frames, with the
same voxels and the same rays.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from common import frames, KITCHEN_SWEEP, machine, say_absent, table
import numpy as np
from numpy.typing import NDArray
import trimesh
from truth import Geometry
import tsdf

from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.settings import Settings
from gr2t_ros.tools.ray_caster import RayCaster

SETTINGS = Settings(voxel_size=0.01, depth_max=3.5, keyframe_translation=0.0)
TSDF_WEIGHT = 2.5  # three views
Row = dict[str, Any]
_EVERY = 5  # odd frames between two that are predicted


def ours(views: Sequence[View], stride: int) -> Geometry:
    """Return the meshes of all views."""
    with closing(Reconstruction(SETTINGS.updated({'ray_stride': stride}))) as reconstruction:
        for view in views:
            reconstruction.add(view)
        reconstruction.finish()
        return Geometry.of([mesh for _, mesh in reconstruction.meshes()])


def theirs(views: Sequence[View]) -> Geometry:
    """Return the TSDF's mesh."""
    grid = tsdf.Tsdf(SETTINGS.voxel_size, SETTINGS.depth_max)
    for view in views:
        grid.integrate(tsdf.Frame(view))
    mesh = grid.mesh(TSDF_WEIGHT)
    return Geometry(mesh.vertices, mesh.faces)


def errors(mesh: Geometry, views: Sequence[View]) -> NDArray[np.float64]:
    """Return how far the mesh's depths are from those observed, metres; NaN where one is none."""
    caster = RayCaster(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False))
    return np.concatenate([
        np.abs(caster.cast(view.T_world_camera, view.camera.rays)[0] - view.depth).reshape(-1)
        for view in views])


def row(name: str, off: NDArray[np.float64], both: NDArray[np.bool_], observed: int) -> Row:
    """Return statistics of errors, and of those where both maps predict something."""
    found = 1e3 * off[np.isfinite(off)]
    return {
        'map': name, 'predicted %': 100 * len(found) / observed,
        'median mm': float(np.median(found)), 'p95 mm': float(np.percentile(found, 95)),
        'where both: median mm': 1e3 * float(np.median(off[both])),
        'p95 mm ': 1e3 * float(np.percentile(off[both], 95)),
        'within 10 mm, of observed %': 100 * float(np.sum(found <= 10)) / observed}


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--data', type=Path, default=Path('../shared/data'), help='its folder')
    parser.add_argument('--stride', type=int, default=4, help='march every n-th pixel (4)')
    arguments = parser.parse_args()
    say_absent(arguments.data)
    views = frames(arguments.data, KITCHEN_SWEEP, 100, SETTINGS)
    if not views:
        return
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, load {about["load"]:.1f}')
    even, odd = views[::2], views[1::2][::_EVERY]
    off = {'gr2t': errors(ours(even, arguments.stride), odd)}
    if tsdf.installed():
        off['TSDF'] = errors(theirs(even), odd)
    both = np.isfinite(sum(off.values()))
    observed = sum(int(np.isfinite(view.depth).sum()) for view in odd)
    rows = [row(name, values, both, observed) for name, values in off.items()]
    table(f'{KITCHEN_SWEEP}: {len(even)} even frames, voxel 1 cm, predict {len(odd)} odd', rows)


if __name__ == '__main__':
    main()
