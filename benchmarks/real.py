# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How well a map of a real recording's even frames predicts the depths of its odd frames.

    python benchmarks/real.py [--data DIR] [--stride 4]

A prediction is where the ray of a pixel first meets the mesh; it does not use the odd frame's
depths. "Our views" are the meshes of all views, one before the other; once more without the
vertices that more even frames see through than see. Beside it, where it is installed, the TSDF of
Open3D (weight >= 3) of the same frames, with the same voxels and the same rays.
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

from gr2t_ros.core.climb import SEEN
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.settings import Settings
from gr2t_ros.tools.ray_caster import RayCaster

SETTINGS = Settings(voxel_size=0.01, depth_max=3.5, keyframe_translation=0.0)
TSDF_WEIGHT = 2.5  # three views
Row = dict[str, Any]
_EVERY = 5  # odd frames between two that are predicted


def ours(views: Sequence[View], stride: int) -> dict[str, Geometry]:
    """Return the meshes of all views, the same without what is seen through, and one mesh."""
    with closing(Reconstruction(SETTINGS.updated({'ray_stride': stride}))) as reconstruction:
        for view in views:
            reconstruction.add(view)
        reconstruction.finish()
        whole = Geometry.of([mesh for _, mesh in reconstruction.meshes()])
        one = reconstruction.fused_mesh()
        return {
            'our views': whole,
            'less what is seen through': whole.only(seen(whole.vertices, views, reconstruction)),
            'our fused mesh': Geometry(one.vertices, one.faces)}


def seen(
    points: NDArray[np.float64], views: Sequence[View], reconstruction: Reconstruction
) -> NDArray[np.bool_]:
    """Tell which points at least as many views see as see through, (n,)."""
    votes = np.zeros(len(points), int)
    for view in views:
        T, camera = view.T_world_camera, view.camera
        x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
        with np.errstate(divide='ignore', invalid='ignore'):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = np.flatnonzero(
            (z > 0) & (u >= 0) & (u < camera.width - 1) & (v >= 0) & (v < camera.height - 1))
        depth = view.depth[np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)]
        behind = (depth - z[inside]) / reconstruction.density.h3(z[inside])
        votes[inside] += (np.abs(behind) <= SEEN).astype(int) - (behind > SEEN)
    return votes >= 0


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


def row(name: str, off: NDArray[np.float64], every: NDArray[np.bool_], observed: int) -> Row:
    """Return statistics of errors, and of those where all maps predict something."""
    found = 1e3 * off[np.isfinite(off)]
    return {
        'map': name, 'predicted %': 100 * len(found) / observed,
        'median mm': float(np.median(found)), 'p95 mm': float(np.percentile(found, 95)),
        'where all: median mm': 1e3 * float(np.median(off[every])),
        'p95 mm ': 1e3 * float(np.percentile(off[every], 95)),
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
    off = {name: errors(mesh, odd) for name, mesh in ours(even, arguments.stride).items()}
    if tsdf.installed():
        off['TSDF'] = errors(theirs(even), odd)
    every = np.isfinite(sum(off.values()))
    observed = sum(int(np.isfinite(view.depth).sum()) for view in odd)
    rows = [row(name, values, every, observed) for name, values in off.items()]
    table(f'{KITCHEN_SWEEP}: {len(even)} even frames, voxel 1 cm, predict {len(odd)} odd', rows)


if __name__ == '__main__':
    main()
