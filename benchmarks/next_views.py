# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether the suggested views show what a scan left out.

    python benchmarks/next_views.py [bunny.ply] [--left-out 150]

Cameras all round the tabletop, and round a mesh in metres, but for one side. Missing is the
surface that those cameras do not see, and that the cameras on that side would. The table has the
share of it that the suggested views see, together with those before them, beside the cameras left
out: the best of them, and their mean, which is what a choice among them at random would see.
"""
from __future__ import annotations

import argparse
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import Any

from common import machine, table
import numpy as np
from numpy.typing import NDArray
import trimesh
from trimesh.sample import sample_surface
from truth import Truth

from gr2t_ros.core.next_views import Attention, where_next
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.settings import Settings
from gr2t_ros.tools.noise import Noise
from gr2t_ros.tools.orbit import orbit, Pose
from gr2t_ros.tools.scenes import tabletop, tabletop_poses
from gr2t_ros.tools.simulate import load_mesh, rendered_views, simulated_camera

CAMERAS = 40  # on the whole way round
NOISE = Noise('gaussian', 0.001)
OUTLIERS = Noise('gaussian', 0.001, 0.05)
SAMPLES = 100_000
STEEPEST = np.radians(78.0)  # against the normal; what is seen more slantwise is not measured
SIDES = (0.0, 120.0, 240.0)  # degrees, of the middle of what is left out
SETTINGS = Settings(
    depth_bandwidth=0.001, depth_bandwidth_quadratic=0.0, ray_stride=2, keyframe_translation=0.02)


def side_of(T_world_camera: Pose, centre: NDArray[np.float64]) -> float:
    """Return the azimuth of a camera about a centre, degrees."""
    x, y = T_world_camera[:2, 3] - centre[:2]
    return float(np.degrees(np.arctan2(y, x)))


def between(one: float, other: float) -> float:
    """Return the angle between two azimuths, degrees."""
    return abs((one - other + 180.0) % 360.0 - 180.0)


def suggested(views: list[View]) -> tuple[Attention, float]:
    """Return what a map of the views suggests, and the seconds that it took."""
    with closing(Reconstruction(SETTINGS)) as reconstruction:
        for view in views:
            reconstruction.add(view)
        reconstruction.finish()
        mesh = reconstruction.fused_mesh()
        where_next(reconstruction, mesh)  # compiles
        began = perf_counter()
        return where_next(reconstruction, mesh), perf_counter() - began


def row(
    mesh: trimesh.Trimesh, poses: list[Pose], side: float, left_out: float, noise: Noise
) -> dict[str, Any]:
    """Leave one side out of a scan, and return what the suggested views see of it."""
    centre = mesh.bounds.mean(axis=0)
    out = [between(side_of(pose, centre), side) < left_out / 2 for pose in poses]
    camera = simulated_camera()
    views = list(rendered_views(
        mesh, camera, [pose for pose, is_out in zip(poses, out) if not is_out], noise=noise))
    found, seconds = suggested(views)

    truth = Truth(mesh, ())  # its own samples, of what two views see, are not asked for
    samples, _ = sample_surface(mesh, SAMPLES, seed=0)

    def seen(pose: Pose) -> NDArray[np.bool_]:
        return truth.sees(camera, pose, samples, STEEPEST)

    scanned = np.any([seen(view.T_world_camera) for view in views], axis=0)
    others = np.stack([seen(pose) for pose, is_out in zip(poses, out) if is_out]) & ~scanned
    missing = others.any(axis=0)
    shares = others[:, missing].mean(axis=1)
    by_us = np.cumsum([seen(view.T_world_camera)[missing] for view in found.views], axis=0) > 0
    first, third = by_us[0].mean(), by_us[:3][-1].mean()
    return {
        'side': f'{side:.0f}', 'missing cm2': 1e4 * mesh.area * missing.mean(),
        'off by': f'{between(side_of(found.views[0].T_world_camera, centre), side):.0f}',
        'first': float(first), 'first three': float(third), 'best left out': float(shares.max()),
        'mean left out': float(shares.mean()), 'first / best': float(first / shares.max()),
        'ms': 1e3 * seconds}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('mesh', nargs='?', type=Path, help='a mesh in metres, such as the bunny')
    parser.add_argument(
        '--left-out', type=float, default=150.0, help='degrees of the way round (150)')
    arguments = parser.parse_args()
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, Python {about["python"]}, load '
          f'{about["load"]:.1f}; {arguments.left_out:g} degrees left out')
    scans = [('tabletop', tabletop(), tabletop_poses(CAMERAS), NOISE)]
    if arguments.mesh:
        mesh = load_mesh(arguments.mesh)
        poses = orbit(mesh.bounds.mean(axis=0), 0.35, CAMERAS)
        scans += [(arguments.mesh.stem, mesh, poses, NOISE),
                  (f'{arguments.mesh.stem}, 5 % outliers', mesh, poses, OUTLIERS)]
    for name, mesh, poses, noise in scans:
        table(f'{name}: share of the missing surface that is seen; angles in degrees', [
            row(mesh, poses, side, arguments.left_out, noise) for side in SIDES])


if __name__ == '__main__':
    main()
