# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The experiment of Grogan & Dahyot (2014) again: 12 simulated views of a mesh, noise 1 mm or none.

    python benchmarks/paper.py bunny.ply [--images DIR]

Distances to the truth, what thresholds keep, likelihood against distance and the cost of a ray,
beside Open3D's TSDF where it is installed: tables, benchmarks/results/paper.json, and pictures in
docs/images. docs/results.md says what the columns mean.
"""
from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any

import bunny
from common import bunny_views, Clock, machine, table
import numpy as np
from numpy.typing import NDArray
import paper_figures as figures
from regimes import KEPT, NEAR, Row, tsdf_mesh
from truth import Geometry
import tsdf

from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.errors import Gr2tError
from gr2t_ros.tools.distance import Surface
from gr2t_ros.tools.noise import Noise
from gr2t_ros.tools.simulate import load_mesh

NOISE = {'none': None, 'sigma 1 mm': Noise('gaussian', sigma=0.001)}
PAPER: Row = {'kept %': 100 * KEPT, 'near, of kept %': 97.0}
EVERY, DEFAULT, LIKELIEST = 'all', 'default thresholds', 'the likeliest'
_ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True, eq=False)
class Cut:
    """
    What thresholds leave of the meshes of the views.

    :param meshes: one a view
    :param likelihood: (n,) of their vertices, one after the other, 1 / (px^2 m)
    :param error: (n,) distances of their vertices to the truth, metres
    """

    meshes: list[Geometry]
    likelihood: NDArray[np.float64]
    error: NDArray[np.float64]

    @classmethod
    def by(cls, reconstruction: Reconstruction, surface: Surface, **thresholds: float) -> Cut:
        """Return what thresholds leave of a reconstruction; those not named at their default."""
        reconstruction.settings = bunny.SETTINGS.updated(thresholds)
        found = [mesh for _, mesh in reconstruction.meshes()]
        return cls(
            [Geometry(mesh.vertices, mesh.faces) for mesh in found],
            np.concatenate([mesh.vertex_likelihood for mesh in found]).astype(np.float64),
            surface.distances(np.concatenate([mesh.vertices for mesh in found])))

    def likeliest(self, share: float) -> Cut:
        """Return what is left with the vertices of the largest likelihoods."""
        kept = self.likelihood >= np.quantile(self.likelihood, 1 - share)
        return Cut(
            [mesh.only(part) for mesh, part in zip(self.meshes, self.parts(kept))],
            self.likelihood[kept], self.error[kept])

    def parts(self, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Return the vertices' values for each view."""
        return np.split(values, np.cumsum([len(mesh.vertices) for mesh in self.meshes])[:-1])


def cuts(reconstruction: Reconstruction, surface: Surface) -> dict[str, Cut]:
    """Return all vertices and what is left of them by our thresholds and by the paper's share."""
    default = Cut.by(reconstruction, surface)
    likeliest = Cut.by(reconstruction, surface, min_confidence=0.0).likeliest(KEPT)
    every = Cut.by(reconstruction, surface, min_confidence=0.0, min_edge_likelihood=0.0)
    return {EVERY: every, DEFAULT: default, LIKELIEST: likeliest}


def distances(noise: str, of: str, error: NDArray[np.float64], every: int | None) -> Row:
    """Return how far vertices are from the truth, and which share of all (a number) they are."""
    d = bunny.distances_mm(error)
    return {
        'noise': noise, 'vertices': of, 'number': len(error),
        'kept %': 100 * len(error) / every if every else None,
        'near, of kept %': 100 * float(np.mean(error <= NEAR)),
        'mean': d['mean'], 'median': d['median'], 'p95': d['p95']}


def tenths(noise: str, cut: Cut, scale: float) -> list[Row]:
    """Return the distances in tenths of the vertices, from the least to the most likely."""
    rows = []
    order = np.argsort(cut.likelihood, kind='stable')
    for n, part in enumerate(np.array_split(order, 10), 1):
        d = bunny.distances_mm(cut.error[part])
        rows.append({
            'noise': noise, 'tenth': n, 'likelihood': float(cut.likelihood[part].mean()) / scale,
            'mean': d['mean'], 'median': d['median'], 'p95': d['p95'],
            'near %': 100 * float(np.mean(cut.error[part] <= NEAR))})
    return rows


def cost(views: list[View], surface: Surface) -> list[Row]:
    """Return what a ray costs on one core, alone and with its share of making the whole map."""
    rows = []
    for density in bunny.DENSITIES:
        clock = Clock()
        with closing(clock(density, bunny.reconstructed, views, density)) as reconstruction:
            ray = bunny.ray_cost(reconstruction, 1)
            vertices = np.concatenate([mesh.vertices for _, mesh in reconstruction.meshes()])
            rays = sum(len(keyframe.rays.pixels) for keyframe in reconstruction.keyframes)
        rows.append({
            'density': density, 'march, us': ray['start us'] + ray['march us'],
            'iterations': ray['evaluations'], 'converged %': 100 * ray['converged'],
            'whole, CPU us': 1e6 * clock.cpu[density] / rays,
            'x the paper': bunny.PAPER_SECONDS * rays / clock.cpu[density],
            'mean': bunny.distances_mm(surface.distances(vertices))['mean']})
    return [*rows, dict.fromkeys(rows[0]) | {
        'density': 'the paper', 'march, us': 1e6 * bunny.PAPER_SECONDS}]


def main() -> None:
    """Measure, print tables, write JSON and pictures."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('mesh', type=Path, help='the true surface, metres, about 0.15 m wide')
    parser.add_argument(
        '--images', metavar='DIR', type=Path, default=_ROOT / 'docs' / 'images',
        help='where pictures go (docs/images)')
    arguments = parser.parse_args()
    try:
        mesh = load_mesh(arguments.mesh)
    except Gr2tError as error:
        parser.error(f'{error}; MESH=FILE with make')
    surface = Surface(mesh.triangles)
    about = machine()
    for density in bunny.DENSITIES:
        warm_up(bunny.SETTINGS.updated({'density': density}))
    print(f'{about["processor"]}, {about["cores"]} cores, Python {about["python"]}, load '
          f'{about["load"]:.1f}')
    if not tsdf.installed():
        print('Open3D is not installed: no TSDF')
    tables: dict[str, list[Row]] = {title: [] for title in (
        'distance to the truth, mm', 'likelihood against distance, mm', 'a ray, one core')}
    kept, against, rays = tables.values()
    clouds: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
    errors: dict[str, dict[str, tuple[Geometry, NDArray[np.float64]]]] = {}
    for noise, model in NOISE.items():
        views = bunny_views(mesh, model)
        with closing(bunny.reconstructed(views, 'voxel')) as reconstruction:
            found, scale = cuts(reconstruction, surface), reconstruction.colouring().scale
        every = found[EVERY]
        kept += [
            distances(noise, of, cut.error, len(every.error)) for of, cut in found.items()]
        against += tenths(noise, every, scale)
        clouds[noise] = every.likelihood / scale, every.error
        errors[noise] = {'gr2t': (Geometry.of(found[DEFAULT].meshes), found[DEFAULT].error)}
        if tsdf.installed():
            other = tsdf_mesh(views, bunny.SETTINGS)
            error = surface.distances(other.vertices)
            kept.append(distances(noise, 'TSDF', error, None))
            errors[noise]['TSDF'] = Geometry(other.vertices, other.faces), error
        if model is None:
            rays += cost(views, surface)
    figures.likelihood(
        arguments.images / 'paper_likelihood.png', {
            f'{of}: {100 * len(cut.error) / len(every.error):.4g} % of the vertices': list(zip(
                cut.meshes, cut.parts(cut.likelihood / scale))) for of, cut in found.items()},
        [view.T_world_camera for view in views], mesh.bounds)
    figures.distance(arguments.images / 'paper_distance.png', errors, mesh.bounds)
    figures.likelihood_against_distance(arguments.images / 'paper_scatter.png', clouds)
    kept.append(dict.fromkeys(kept[0]) | {'noise': '?', 'vertices': 'the paper'} | PAPER)
    for title, rows in tables.items():
        table(title, rows)
    results = _ROOT / 'benchmarks' / 'results' / 'paper.json'
    results.parent.mkdir(exist_ok=True)
    results.write_text(json.dumps({'machine': about} | tables, indent=1), encoding='utf-8')
    print(f'\nfigures in {results}, pictures in {arguments.images}')


if __name__ == '__main__':
    main()
