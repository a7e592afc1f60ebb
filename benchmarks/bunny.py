# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How far from the truth the vertices lie, and what a ray costs: 12 simulated views of a mesh.

    python benchmarks/bunny.py bunny.ply [--json out.json]

Beside it, where it is installed, Open3D's TSDF of the same images (1 mm voxels, weight >= 3).
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
import json
import os
import platform
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
import trimesh

from gr2t_ros.core.ray_march import march, rays_of, Status
from gr2t_ros.core.reconstruction import Reconstruction, warm_up
from gr2t_ros.core.view import View
from gr2t_ros.settings import Settings
from gr2t_ros.tools.distance import Surface
from gr2t_ros.tools.noise import Noise
from gr2t_ros.tools.simulate import simulated_views

SETTINGS = Settings(
    pixel_bandwidth=1.5, depth_bandwidth=0.001, depth_bandwidth_quadratic=0.0,
    keyframe_translation=0.0)
CASES = {
    '32FC1, no noise': ('32FC1', None),
    '16UC1, no noise': ('16UC1', None),
    '32FC1, sigma 1 mm': ('32FC1', Noise('gaussian', sigma=0.001)),
}
PAPER_SECONDS = 0.5162  # a ray, Grogan & Dahyot 2014
REPEATS = 3


def reconstructed(views: Sequence[View]) -> Reconstruction:
    """Return the finished reconstruction of the views, each a keyframe."""
    reconstruction = Reconstruction(SETTINGS.updated({'remarch_budget': 0.0}))
    for view in views:
        reconstruction.add(view)
    reconstruction.finish()
    return reconstruction


def distances_mm(surface: Surface, points: NDArray[np.float64]) -> dict[str, float]:
    """Return statistics of the distances from points to the true surface."""
    d = 1e3 * surface.distances(points)
    return {
        'mean': float(d.mean()), 'median': float(np.median(d)), 'p95': float(np.quantile(d, 0.95)),
        'vertices': len(d)}


def ray_cost(reconstruction: Reconstruction, threads: int) -> dict[str, float]:
    """March every ray of every keyframe once more, and the best of some runs."""
    density = reconstruction.density
    with ThreadPoolExecutor(threads) as pool:
        best: dict[str, float] = {}
        for _ in range(REPEATS):
            began = perf_counter()
            rays = [
                rays_of(density, index, keyframe.view, 1, 'robust', pool)
                for index, keyframe in enumerate(reconstruction.keyframes)]
            started = perf_counter()
            for one in rays:
                march(density, one, np.ones(len(one.pixels), np.bool_), pool)
            ended = perf_counter()
            count = sum(len(one.pixels) for one in rays)
            if not best or (ended - started) / count * 1e6 < best['march_us']:
                status = np.concatenate([one.status for one in rays])
                best = {
                    'start_us': (started - began) / count * 1e6,
                    'march_us': (ended - started) / count * 1e6,
                    'evaluations': float(np.mean(
                        np.concatenate([one.iterations for one in rays]))),
                    'converged': float(np.mean(status == Status.CONVERGED)),
                    'rays': count}
    return best


def tsdf_vertices(views: Sequence[View]) -> NDArray[np.float64] | None:
    """Return the vertices of Open3D's TSDF of the same depth images, or None without Open3D."""
    try:
        import open3d
    except ImportError:
        return None
    core = open3d.core
    grid = open3d.t.geometry.VoxelBlockGrid(
        ('tsdf', 'weight'), (core.float32, core.float32), ((1), (1)), 0.001, 8, 40000)
    for view in views:
        camera = view.camera
        K = core.Tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        T = core.Tensor(np.linalg.inv(view.T_world_camera))
        depth = open3d.t.geometry.Image(core.Tensor(np.nan_to_num(view.depth)))
        blocks = grid.compute_unique_block_coordinates(depth, K, T, 1.0, 5.0, 4.0)
        grid.integrate(blocks, depth, K, T, 1.0, 5.0, 4.0)
    mesh = grid.extract_triangle_mesh(weight_threshold=3.0)
    return mesh.vertex.positions.numpy().astype(np.float64)


def main() -> None:
    """Measure, print a table, write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('mesh', help='the true surface, metres')
    parser.add_argument('--json', metavar='FILE', help='also write the figures there')
    arguments = parser.parse_args()
    mesh = trimesh.load_mesh(arguments.mesh)
    surface = Surface(mesh.triangles)
    print(f'{platform.processor() or platform.machine()}, {os.cpu_count()} cores, '
          f'Python {platform.python_version()}; kernels ready in {warm_up(SETTINGS):.1f} s')
    figures: dict[str, object] = {}
    print(f'\n{"distance to the truth, mm":28}{"mean":>8}{"median":>8}{"p95":>8}{"vertices":>10}')
    for name, (encoding, noise) in CASES.items():
        views = simulated_views(mesh, 12, 0.35, encoding=encoding, noise=noise)
        reconstruction = reconstructed(views)
        vertices = np.concatenate([m.vertices for _, m in reconstruction.meshes()])
        rows = {'ours': vertices, 'TSDF': tsdf_vertices(views)}
        for method, points in rows.items():
            if points is None:
                print(f'{name + ": " + method:28} Open3D is not installed')
                continue
            found = distances_mm(surface, points)
            figures[f'{name}, {method}'] = found
            print(f'{name + ": " + method:28}{found["mean"]:8.3f}{found["median"]:8.3f}'
                  f'{found["p95"]:8.3f}{found["vertices"]:10d}')
        if name == next(iter(CASES)):
            costs = {threads: ray_cost(reconstruction, threads) for threads in (1, 2)}
        reconstruction.close()
    print(f'\n{"a ray, 12 views":28}{"start us":>10}{"march us":>10}{"evaluations":>13}'
          f'{"converged":>11}{"x the paper":>13}')
    for threads, cost in costs.items():
        figures[f'ray, {threads} threads'] = cost
        faster = PAPER_SECONDS / (1e-6 * (cost['start_us'] + cost['march_us']))
        print(f'{threads} thread{"s" * (threads > 1):21}{cost["start_us"]:10.2f}'
              f'{cost["march_us"]:10.2f}{cost["evaluations"]:13.2f}{cost["converged"]:11.4f}'
              f'{faster:13.0f}')
    if arguments.json:
        with open(arguments.json, 'w', encoding='utf-8') as file:
            json.dump(figures, file, indent=1)


if __name__ == '__main__':
    main()
