# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The lattice against the exact sum, and frame by frame against all at once."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import closing
import os
from pathlib import Path
from typing import Any

from common import BUNNY, bunny_views, found, frames, KITCHEN_30HZ, table
import numpy as np
from numpy.typing import NDArray
import trimesh

from gr2t_ros.core.exact_density import ExactDensity
from gr2t_ros.core.ray_march import Density, march, Rays, rays_of, watched_blocks
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.view_mesh import view_mesh, ViewMesh
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.settings import Settings
from gr2t_ros.tools.distance import Surface
from gr2t_ros.tools.noise import Noise

_VOXEL_SIZE = 0.001  # metres
_CASES = (  # sigma, h3, metres
    (0.0, 0.001), (0.001, 0.001), (0.002, 0.002))


def settings_of(h3: float, voxel_size: float) -> Settings:
    """Return settings with a constant h3 in which every frame owns a mesh."""
    return Settings(
        depth_bandwidth=h3, depth_bandwidth_quadratic=0.0, voxel_size=voxel_size,
        keyframe_translation=0.0)


def measure_accuracy(data: Path, count: int) -> dict[str, Any]:
    """
    Print and return how far the lattice's maxima are from the exact ones.

    :param count: views of the bunny
    """
    lattice, incremental = _bunny(found(data, BUNNY), count)
    table('bunny, voxel 1 mm: lattice against exact sum, along the rays in h3', lattice)
    incremental += _kitchen(data, count)
    table('frame by frame against all at once, along the rays in h3', incremental)
    return {'lattice against exact': lattice, 'incremental against batch': incremental}


def _bunny(path: Path | None, count: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return what the lattice differs from the exact sum, and each frame's from all at once."""
    lattice: list[dict[str, Any]] = []
    incremental: list[dict[str, Any]] = []
    if path is None:
        return lattice, incremental
    mesh = trimesh.load_mesh(path)
    surface = Surface(mesh.triangles)
    for sigma, h3 in _CASES:
        views = bunny_views(mesh, Noise('gaussian', sigma=sigma) if sigma else None)[:count]
        settings = settings_of(h3, _VOXEL_SIZE)
        case = {'sigma mm': 1e3 * sigma, 'h3 mm': 1e3 * h3}
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            exact, exact_meshes = _at_once(
                ExactDensity(settings.pixel_bandwidth, h3), views, settings, pool)
            voxel, _ = _at_once(_voxel_density(settings), views, settings, pool)
        steps, voxel_meshes = _frame_by_frame(views, settings)
        lattice.append(case | _compared(exact, voxel, h3) | _to_truth(
            surface, exact_meshes, voxel_meshes))
        incremental.append({'data': BUNNY} | case | _largest(voxel, steps, h3))
    return lattice, incremental


def _voxel_density(settings: Settings) -> VoxelDensity:
    return VoxelDensity(
        settings.pixel_bandwidth, settings.depth_bandwidth, settings.depth_bandwidth_quadratic,
        settings.voxel_size, settings.depth_max)


def _at_once(
    density: Density, views: Sequence[View], settings: Settings, pool: Executor
) -> tuple[list[Rays], list[ViewMesh]]:
    """Add all views, then march all their rays once."""
    for view in views:
        density.add(view, pool)
    all_rays = [rays_of(density, view, 1, settings.start, pool) for view in views]
    if isinstance(density, VoxelDensity):
        for rays in all_rays:
            watched_blocks(density, rays)  # as a keyframe's rays are
    density.refresh(pool)
    meshes = []
    for view, rays in zip(views, all_rays):
        march(density, rays, np.arange(len(rays.pixels)), pool)
        meshes.append(view_mesh(
            density, rays, view.camera.width, 1, settings.min_confidence,
            settings.min_edge_likelihood, pool))
    return all_rays, meshes


def _frame_by_frame(
    views: Sequence[View], settings: Settings
) -> tuple[list[Rays], list[ViewMesh]]:
    with closing(Reconstruction(settings)) as reconstruction:
        for view in views:
            reconstruction.add(view)
        reconstruction.finish()
        return (
            [keyframe.rays for keyframe in reconstruction.keyframes],
            [mesh for _, mesh in reconstruction.meshes()])


def _joined(all_rays: Iterable[Rays], name: str) -> NDArray[Any]:
    return np.concatenate([getattr(rays, name) for rays in all_rays])


def _compared(exact: list[Rays], voxel: list[Rays], h3: float) -> dict[str, Any]:
    both = _joined(exact, 'converged') & _joined(voxel, 'converged')
    apart = np.abs(_joined(voxel, 'depth') - _joined(exact, 'depth'))[both] / h3
    likelihood = _joined(exact, 'total')[both]
    error = np.abs(_joined(voxel, 'total')[both] - likelihood) / likelihood
    return {
        'rays': len(both), 'p50': float(np.median(apart)), 'p95': float(np.percentile(apart, 95)),
        'likelihood p50 %': 100 * float(np.median(error)),
        'likelihood p95 %': 100 * float(np.percentile(error, 95)),
        'one only converged %': 100 * float(np.mean(
            _joined(exact, 'converged') != _joined(voxel, 'converged')))}


def _to_truth(
    surface: Surface, exact: list[ViewMesh], voxel: list[ViewMesh]
) -> dict[str, Any]:
    exact_mm, voxel_mm = (
        1e3 * surface.distances(np.concatenate([one.vertices for one in meshes]))
        for meshes in (exact, voxel))
    return {
        'exact mm': float(exact_mm.mean()), 'lattice mm': float(voxel_mm.mean()),
        'ratio': float(voxel_mm.mean() / exact_mm.mean()),
        'vertices': float(len(voxel_mm) / len(exact_mm))}


def _kitchen(data: Path, count: int) -> list[dict[str, Any]]:
    settings = settings_of(0.01, 0.01).updated({'depth_max': 3.5})
    views = frames(data, KITCHEN_30HZ, count, settings)
    if not views:
        return []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        batch, _ = _at_once(_voxel_density(settings), views, settings, pool)
    steps, _ = _frame_by_frame(views, settings)
    return [{'data': KITCHEN_30HZ, 'sigma mm': None, 'h3 mm': 10.0} | _largest(
        batch, steps, 0.01)]


def _largest(batch: list[Rays], steps: list[Rays], h3: float) -> dict[str, Any]:
    apart = np.abs(_joined(batch, 'depth') - _joined(steps, 'depth')) / h3
    both = _joined(batch, 'converged') & _joined(steps, 'converged')
    return {
        'rays': len(apart), 'largest': float(apart[both].max(initial=0)),
        'not equal': int(np.count_nonzero(apart[both])),
        'other status': int(np.count_nonzero(
            _joined(batch, 'status') != _joined(steps, 'status')))}
