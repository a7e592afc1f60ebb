# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Accuracy and confidence under several kinds of noise: 12 simulated views of a mesh.

    python benchmarks/regimes.py bunny.ply [--exact] [--only NOISE ...] [--oracle 6] [--scale 0.7]

Beside it, where it is installed, Open3D's TSDF of the same images with the same voxels, truncation
4 voxels, weight >= 3. docs/results.md says what the columns mean.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, replace
import json
from pathlib import Path
from time import thread_time
from typing import Any

from common import machine, table
import numpy as np
from numpy.typing import NDArray
import trimesh
from truth import Geometry, Truth
import tsdf

from gr2t_ros.core.confidence import confidences, deviations
from gr2t_ros.core.ray_march import rays_of
from gr2t_ros.core.reconstruction import Keyframe, Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.settings import Settings
from gr2t_ros.tools.evaluate import nause
from gr2t_ros.tools.noise import Noise
from gr2t_ros.tools.simulate import load_mesh, simulated_views

VIEWS = 12
KEPT = 0.7365  # share of the vertices that Grogan & Dahyot (2014) keep
NEAR = 0.001  # metres
TSDF_WEIGHT = 2.5  # three views
_JUMP = 4.0  # h3; smaller steps are no depth discontinuity to the method
_GAPS = (_JUMP, 8.0, 20.0, np.inf)  # h3
_SMOOTH = 0.5  # of the whole change; a larger part of it in one eighth of a pixel is a jump


@dataclass(frozen=True)
class Regime:
    """
    A kind of noise, and how it is mapped.

    :param noise: of the sensor
    :param distance: of the cameras, metres
    :param h3: bandwidth along the depth, metres
    :param sigma: the noise's standard deviation along the depth, metres
    :param voxel_size: metres
    """

    noise: Noise | None
    distance: float
    h3: float
    sigma: float
    voxel_size: float

    def settings(self, **changes: Any) -> Settings:
        """Return settings with which every view owns a mesh; the rest at its default."""
        return Settings(
            depth_bandwidth=self.h3, depth_bandwidth_quadratic=0.0, voxel_size=self.voxel_size,
            keyframe_translation=0.0, remarch_budget=0.0).updated(changes)

    def views(self, mesh: trimesh.Trimesh, seed: int) -> list[View]:
        """Return the simulated views."""
        return simulated_views(mesh, VIEWS, self.distance, noise=self.noise, seed=seed)


REGIMES = {
    'none': Regime(None, 0.35, 0.001, 0.0, 0.001),
    '1 mm': Regime(Noise('gaussian', 0.001), 0.35, 0.001, 0.001, 0.001),
    '2 mm': Regime(Noise('gaussian', 0.002), 0.35, 0.002, 0.002, 0.002),
    '2 mm, voxel 1 mm': Regime(Noise('gaussian', 0.002), 0.35, 0.002, 0.002, 0.001),
    '1 mm, 5 % outliers': Regime(Noise('gaussian', 0.001, 0.05), 0.35, 0.001, 0.001, 0.001),
    'kinect, 0.8 m': Regime(Noise('kinect'), 0.8, 0.0015, 0.0015, 0.0015),
    'kinect, 1.5 m': Regime(Noise('kinect'), 1.5, 0.0035, 0.0035, 0.0035),
}
Row = dict[str, Any]


class Found:
    """
    The maxima of all rays, before any threshold.

    :param error: (n,) distance to the surface, metres
    :param along: (n,) error along the ray, metres; NaN where the ray hits nothing
    :param ray: (n,) a number of its own for each pixel of each view
    """

    def __init__(self, reconstruction: Reconstruction, truth: Truth) -> None:
        density = reconstruction.density
        parts: list[tuple[NDArray[Any], ...]] = []
        for keyframe in reconstruction.keyframes:
            rays = keyframe.rays
            which = np.flatnonzero(rays.converged)
            sigma = deviations(density, rays, which)
            true = truth.depth(keyframe.view).reshape(-1)[rays.pixels[which]]
            parts.append((
                len(parts) * rays.table.size + rays.pixels[which].astype(np.int64),
                truth.surface.distances(rays.points(which)), rays.depth[which] - true,
                rays.total[which], sigma, confidences(sigma, density.h3(rays.depth[which]))))
        self.ray, self.error, self.along, self.likelihood, self.sigma, self.confidence = (
            np.concatenate(column) for column in zip(*parts))


def reconstructed(views: Sequence[View], settings: Settings) -> Reconstruction:
    """Return the finished reconstruction of the views."""
    reconstruction = Reconstruction(settings)
    for view in views:
        reconstruction.add(view)
    reconstruction.finish()
    return reconstruction


def accuracy(name: str, of: str, mesh: Geometry, truth: Truth) -> Row:
    """Return how far a mesh's vertices are from the surface, and how much of it they cover."""
    error = truth.surface.distances(mesh.vertices)
    complete = truth.completeness(mesh, NEAR)
    precise = float(np.mean(error <= NEAR))
    return {
        'noise': name, 'of': of, 'vertices': len(error), 'mean': 1e3 * float(error.mean()),
        'median': 1e3 * float(np.median(error)), 'p95': 1e3 * float(np.percentile(error, 95)),
        '> 1 mm %': 100 * (1 - precise), 'complete %': 100 * complete,
        'F %': 200 * precise * complete / (precise + complete)}


def best(mesh: Geometry, score: NDArray[Any]) -> Geometry:
    """Return the share KEPT of a mesh's vertices with the largest scores."""
    kept = np.zeros(len(score), bool)
    kept[np.argsort(-score, kind='stable')[:round(KEPT * len(score))]] = True
    return mesh.only(kept)


def confidence(name: str, start: str, found: Found, regime: Regime, least: float) -> tuple[
        Row, Row]:
    """Return NAUSE with purity and retention, and the calibration of sigma by tenths."""
    near = found.error <= max(NEAR, 2 * regime.sigma)
    kept = found.confidence >= least
    row = {'noise': name, 'start': start, 'rays': len(near)} | {
        f'NAUSE {score}': nause(found.error, values) for score, values in (
            ('likelihood', found.likelihood), ('sigma', -found.sigma),
            ('confidence', found.confidence))} | {
        'near %': 100 * float(near.mean()), 'near, of kept %': 100 * float(near[kept].mean()),
        'kept, of near %': 100 * float(kept[near].mean())}
    # what lies on another surface is an outlier, of which sigma says nothing
    counts = np.isfinite(found.sigma) & (np.abs(found.along) < _JUMP * regime.h3)
    along, sigma = found.along[counts], found.sigma[counts]
    tenths: Row = {'noise': name, 'start': start, 'counted %': 100 * float(counts.mean())}
    for n, part in enumerate(np.array_split(np.argsort(sigma, kind='stable'), 10), 1):
        rms = float(np.sqrt(np.mean(along[part] ** 2)))
        tenths[f'{10 * n} %'] = rms / float(sigma[part].mean())
    return row, tenths


def oracle(
    name: str, found: Found, mesh: trimesh.Trimesh, truth: Truth, regime: Regime,
    seeds: Sequence[int],
) -> Row:
    """
    Return what cannot be known: NAUSE of the errors of the same rays with other noise.

    Also, as medians over the rays, the mean of their errors along themselves and their scatter.
    """
    size = int(found.ray.max()) + 1
    squares, counts, along, along_squares = np.zeros((4, size))
    for seed in seeds:
        with closing(reconstructed(
                regime.views(mesh, seed), regime.settings())) as reconstruction:
            other = Found(reconstruction, truth)
        # what lies on another surface is an outlier
        there = np.flatnonzero((other.ray < size) & (np.abs(other.along) < _JUMP * regime.h3))
        rays = other.ray[there]
        counts[rays] += 1
        squares[rays] += other.error[there] ** 2
        along[rays] += other.along[there]
        along_squares[rays] += other.along[there] ** 2
    known = counts[found.ray] >= max(len(seeds) / 2, 2)
    rays = found.ray[known]
    count = counts[rays]
    mean = along[rays] / count
    scatter = np.sqrt(np.maximum(along_squares[rays] / count - mean ** 2, 0) * count / (count - 1))
    return {
        'noise': name, 'other seeds': len(seeds),
        'NAUSE of their errors': nause(found.error[known], -np.sqrt(squares[rays] / count)),
        'NAUSE of sigma': nause(found.error[known], -found.sigma[known]),
        'mean error along, mm': 1e3 * float(np.median(np.abs(mean))),
        'scatter, mm': 1e3 * float(np.median(scatter))}


def edges(name: str, reconstruction: Reconstruction, truth: Truth, regime: Regime) -> Row:
    """
    Return how many edges across true jumps the thresholds leave, and how many good ones they cut.

    Edges count whose two vertices are found where their rays truly end.
    """
    jumps, left = np.zeros(len(_GAPS) - 1, int), np.zeros(len(_GAPS) - 1, int)
    good_ones = cut = cut_with_vertex = 0
    for number, keyframe in enumerate(reconstruction.keyframes):
        camera, rays = keyframe.view.camera, keyframe.rays
        shape = (camera.height, camera.width)
        right = np.zeros(shape, bool).reshape(-1)
        off = np.abs(rays.depth - truth.depth(keyframe.view).reshape(-1)[rays.pixels])
        right[rays.pixels] = rays.converged & (off < max(NEAR, 2 * regime.sigma))
        vertices, kept = _pixels_of_mesh(reconstruction, number, keyframe)
        has_vertex = np.zeros(right.shape, bool)
        has_vertex[vertices] = True
        for across, down in ((1, 0), (0, 1), (1, 1)):
            v, u = np.mgrid[:camera.height - down, :camera.width - across]
            a = (v * camera.width + u).reshape(-1)
            b = a + down * camera.width + across
            both = right[a] & right[b]
            a, b = a[both], b[both]
            step, change = truth.steps(keyframe.view, a, across, down)
            jump = (step > _SMOOTH * change) & (change > _JUMP * regime.h3)
            good = step <= _SMOOTH * np.maximum(change, regime.h3)
            stays = np.isin(a * np.int64(rays.table.size) + b, kept)
            jumps += np.histogram(change[jump] / regime.h3, _GAPS)[0]
            left += np.histogram(change[jump & stays] / regime.h3, _GAPS)[0]
            good_ones += int(good.sum())
            cut += int((good & ~stays).sum())
            cut_with_vertex += int((good & ~(has_vertex[a] & has_vertex[b])).sum())
    return {
        'noise': name, 'across jumps > 4 h3': int(jumps.sum()),
        'left %': _percent(left.sum(), jumps.sum())} | {
        f'of {low:g} to {high:g} h3': _percent(*counts)
        for low, high, *counts in zip(_GAPS, _GAPS[1:], left, jumps)} | {
        'good': good_ones, 'cut %': _percent(cut, good_ones),
        'with a vertex %': _percent(cut_with_vertex, good_ones),
        'alone %': _percent(cut - cut_with_vertex, good_ones)}


def _percent(part: int, whole: int) -> float | None:
    return 100 * float(part) / float(whole) if whole else None


def _pixels_of_mesh(
    reconstruction: Reconstruction, number: int, keyframe: Keyframe
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pixels of a keyframe's vertices, and its edges as a number for each pair."""
    mesh, camera = reconstruction.mesh(number), keyframe.view.camera
    T = keyframe.view.T_world_camera
    x, y, z = ((mesh.vertices - T[:3, 3]) @ T[:3, :3]).T
    u = np.rint(camera.fx * x / z + camera.cx).astype(np.int64)
    v = np.rint(camera.fy * y / z + camera.cy).astype(np.int64)
    pixels = v * camera.width + u
    return pixels, (
        pixels[mesh.edges[:, 0]] * keyframe.rays.table.size + pixels[mesh.edges[:, 1]])


def starts(name: str, reconstruction: Reconstruction, truth: Truth, regime: Regime) -> Row:
    """Return what becomes of outliers with the robust start, and what it does to other pixels."""
    close, unit = max(NEAR, 2 * regime.sigma), max(NEAR, regime.sigma)
    outliers = back = along = others = moved = 0
    seconds = {'robust': 0.0, 'observed': 0.0}
    for keyframe in reconstruction.keyframes:
        rays = keyframe.rays
        # a frame that was just added has its warped image already
        rays_of(reconstruction.density, keyframe.view, 1, 'robust')
        for start in seconds:
            began = thread_time()
            rays_of(reconstruction.density, keyframe.view, 1, start)
            seconds[start] += thread_time() - began
        true = truth.depth(keyframe.view).reshape(-1)[rays.pixels]
        observed = keyframe.view.depth.reshape(-1)[rays.pixels]
        off = np.abs(observed - true)
        ended = np.where(rays.converged, np.abs(rays.depth - true), np.inf)
        far = np.flatnonzero(off > 5 * unit)
        outliers += len(far)
        found = far[rays.converged[far]]
        back += int(np.sum(truth.surface.distances(rays.points(found)) <= unit))
        along += int(np.sum(ended[far] < close))
        inlier = off < 3 * unit
        others += int(inlier.sum())
        moved += int(np.sum(inlier & (rays.start != observed) & (ended > 5 * unit)))
    return {
        'noise': name, 'outliers': outliers,
        'end within 1 mm or sigma of the surface %': _percent(back, outliers),
        'along the ray within 2 sigma %': _percent(along, outliers),
        'inliers': others, 'moved to another surface %': _percent(moved, others),
        'start, ns a ray': 1e9 * (seconds['robust'] - seconds['observed']) / sum(
            len(keyframe.rays.pixels) for keyframe in reconstruction.keyframes)}


def tsdf_mesh(views: Sequence[View], settings: Settings) -> tsdf.Mesh:
    """Return Open3D's TSDF of the same images."""
    grid = tsdf.Tsdf(settings.voxel_size, settings.depth_max)
    for view in views:
        grid.integrate(tsdf.Frame(view))
    return grid.mesh(TSDF_WEIGHT)


def main() -> None:
    """Measure, print tables, write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('mesh', type=Path, help='the true surface, metres')
    parser.add_argument('--exact', action='store_true', help='also the exact density')
    parser.add_argument('--only', nargs='+', choices=REGIMES, default=list(REGIMES))
    parser.add_argument(
        '--scale', type=float, default=1.0, help='of h3 and the voxels, the TSDF\'s too (1)')
    parser.add_argument(
        '-p', metavar='NAME:=VALUE', action='append', default=[], help='a parameter of ours')
    parser.add_argument('--seed', type=int, default=0, help='of the noise (0)')
    parser.add_argument(
        '--oracle', metavar='SEEDS', type=int, default=0,
        help='also how well the errors with so many other seeds order those with this one')
    parser.add_argument('--json', metavar='FILE', help='also write the figures there')
    arguments = parser.parse_args()
    changes = dict(change.split(':=', 1) for change in arguments.p)
    mesh = load_mesh(arguments.mesh)
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, Python {about["python"]}, load '
          f'{about["load"]:.1f}')
    if not tsdf.installed():
        print('Open3D is not installed: no TSDF')
    tables: dict[str, list[Row]] = {title: [] for title in (
        'distance to the truth, mm', 'scores', 'rms error / mean sigma, tenths by sigma', 'edges',
        'starts', 'oracle')}
    distances, scores, tenths, cut, begun, ideal = tables.values()
    for name in arguments.only:
        regime = REGIMES[name]
        regime = replace(
            regime, h3=arguments.scale * regime.h3, voxel_size=arguments.scale * regime.voxel_size)
        views = regime.views(mesh, arguments.seed)
        truth = Truth(mesh, views)
        ours: list[Row] = []
        for density in ('voxel', 'exact') if arguments.exact else ('voxel',):
            settings = regime.settings(**changes, density=density)
            warm_up(settings)
            with closing(reconstructed(views, settings)) as reconstruction:
                meshes = [one for _, one in reconstruction.meshes()]
                whole = Geometry.of(meshes)
                score = np.concatenate([one.vertex_confidence for one in meshes])
                ours += [
                    accuracy(name, density, whole, truth),
                    accuracy(name, f'{density}, best', best(whole, score), truth)]
                if density == 'exact':
                    continue
                fused = reconstruction.fused_mesh()
                one = Geometry(fused.vertices, fused.faces)
                ours += [
                    accuracy(name, 'fused', one, truth),
                    accuracy(name, 'fused, best', best(one, fused.vertex_confidence), truth)]
                found = Found(reconstruction, truth)
                row, tenth = confidence(name, 'robust', found, regime, settings.min_confidence)
                scores.append(row)
                tenths.append(tenth)
                cut.append(edges(name, reconstruction, truth, regime))
                begun.append(starts(name, reconstruction, truth, regime))
            if arguments.oracle:
                ideal.append(oracle(name, found, mesh, truth, regime, [
                    arguments.seed + 1 + n for n in range(arguments.oracle)]))
        with closing(reconstructed(
                views, regime.settings(**changes, start='observed'))) as reconstruction:
            row, tenth = confidence(
                name, 'observed', Found(reconstruction, truth), regime, settings.min_confidence)
            scores.append(row)
            tenths.append(tenth)
        if tsdf.installed():
            other = tsdf_mesh(views, settings)
            whole = Geometry(other.vertices, other.faces)
            rows = [
                accuracy(name, 'TSDF', whole, truth),
                accuracy(name, 'TSDF, best', best(whole, other.weight), truth)]
            for row in ours:
                row['/ TSDF'] = row['mean'] / rows[row['of'].endswith('best')]['mean']
            ours += [row | {'/ TSDF': None} for row in rows]
        distances += ours
    for title, rows in tables.items():
        if rows:
            table(title, rows)
    if arguments.json:
        with open(arguments.json, 'w', encoding='utf-8') as file:
            json.dump({'machine': about} | tables, file, indent=1)


if __name__ == '__main__':
    main()
