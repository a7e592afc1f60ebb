# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How far from the truth the vertices lie, and what a ray costs: 12 simulated views of a mesh.

    python benchmarks/bunny.py bunny.ply [--json out.json]

The exact density and the lattice (1 mm voxels); beside them, where it is installed, Open3D's TSDF
of the same images (1 mm voxels, weight >= 3).
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
import json
from time import perf_counter
from typing import Any

from common import bunny_views, machine, table
import numpy as np
from numpy.typing import NDArray
import trimesh
import tsdf

from gr2t_ros.core.ray_march import march, rays_of
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.settings import Settings
from gr2t_ros.tools.distance import Surface
from gr2t_ros.tools.noise import Noise

SETTINGS = Settings(
    depth_bandwidth=0.001, depth_bandwidth_quadratic=0.0, voxel_size=0.001,
    keyframe_translation=0.0)
DENSITIES = ('exact', 'voxel')
CASES = {
    '32FC1, no noise': ('32FC1', None),
    '16UC1, no noise': ('16UC1', None),
    '32FC1, sigma 1 mm': ('32FC1', Noise('gaussian', sigma=0.001)),
}
PAPER_SECONDS = 0.5162  # a ray, Grogan & Dahyot 2014
REPEATS = 3
TSDF_WEIGHT = 2.5  # three views


def reconstructed(views: Sequence[View], density: str) -> Reconstruction:
    """Return the finished reconstruction of the views, each a keyframe."""
    reconstruction = Reconstruction(SETTINGS.updated({'remarch_budget': 0.0, 'density': density}))
    for view in views:
        reconstruction.add(view)
    reconstruction.finish()
    return reconstruction


def distances_mm(distances: NDArray[np.float64]) -> dict[str, float]:
    """Return statistics of distances (metres) to the true surface."""
    d = 1e3 * distances
    return {
        'mean': float(d.mean()), 'median': float(np.median(d)), 'p95': float(np.quantile(d, 0.95)),
        'vertices': len(d)}


def ray_cost(reconstruction: Reconstruction, threads: int) -> dict[str, float]:
    """March every ray of every keyframe once more, and return the best of some runs."""
    density = reconstruction.density
    runs = []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(REPEATS):
            began = perf_counter()
            rays = [
                rays_of(density, keyframe.view, 1, SETTINGS.start, pool)
                for keyframe in reconstruction.keyframes]
            started = perf_counter()
            for one in rays:
                march(density, one, np.arange(len(one.pixels)), pool)
            ended = perf_counter()
            count = sum(len(one.pixels) for one in rays)
            runs.append({
                'start us': 1e6 * (started - began) / count,
                'march us': 1e6 * (ended - started) / count,
                'evaluations': float(np.mean(np.concatenate([one.iterations for one in rays]))),
                'converged': float(np.mean(np.concatenate([one.converged for one in rays])))})
    return min(runs, key=lambda run: run['march us'])


def tsdf_vertices(views: Sequence[View]) -> NDArray[np.float64]:
    """Return the vertices of Open3D's TSDF of the same depth images."""
    grid = tsdf.Tsdf(SETTINGS.voxel_size, SETTINGS.depth_max)
    for view in views:
        grid.integrate(tsdf.Frame(view))
    return grid.mesh(TSDF_WEIGHT).vertices


def main() -> None:
    """Measure, print tables, write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('mesh', help='the true surface, metres')
    parser.add_argument('--json', metavar='FILE', help='also write the figures there')
    arguments = parser.parse_args()
    mesh = trimesh.load_mesh(arguments.mesh)
    surface = Surface(mesh.triangles)
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, Python {about["python"]}; kernels ready '
          f'in {sum(warm_up(SETTINGS.updated({"density": name})) for name in DENSITIES):.1f} s')
    if not tsdf.installed():
        print('Open3D is not installed: no TSDF')
    distances: list[dict[str, Any]] = []
    costs: list[dict[str, Any]] = []
    for case, (encoding, noise) in CASES.items():
        views = bunny_views(mesh, noise, encoding)
        for density in DENSITIES:
            with closing(reconstructed(views, density)) as reconstruction:
                vertices = np.concatenate([m.vertices for _, m in reconstruction.meshes()])
                distances.append({'images': case, 'density': density} | distances_mm(
                    surface.distances(vertices)))
                if case == next(iter(CASES)):
                    costs += [
                        {'density': density, 'threads': threads} | ray_cost(
                            reconstruction, threads) for threads in (1, 2)]
        if tsdf.installed():
            distances.append({'images': case, 'density': 'TSDF'} | distances_mm(
                surface.distances(tsdf_vertices(views))))
    for cost in costs:
        cost['x the paper'] = PAPER_SECONDS / (1e-6 * (cost['start us'] + cost['march us']))
    table('distance to the truth, mm', distances)
    table(f'a ray, {len(views)} views', costs)
    if arguments.json:
        with open(arguments.json, 'w', encoding='utf-8') as file:
            json.dump({'machine': about, 'distances': distances, 'ray': costs}, file, indent=1)


if __name__ == '__main__':
    main()
