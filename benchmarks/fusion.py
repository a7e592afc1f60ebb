# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
One mesh of many views: how good it is, what it costs, and whether an update equals a rebuild.

    python benchmarks/fusion.py [--data DIR] [--only bunny|kitchen] [--frames N] [--json out.json]

bunny: 12 simulated views with noise, against the truth, in mm: distance of the vertices; share of
the surface that two views saw within 0.5 and 1 mm of the mesh; layers: of the rays that meet the
surface at less than 60 degrees, how many more faces towards the camera lie within 3 mm (3 voxels
in the kitchen) behind the first; edges of more than two faces; parts. kitchen: a Kinect's
recording at 1 cm; the angle between neighbouring faces tells how rough the mesh is. Beside it,
where it is installed, Open3D's TSDF of the raw depth images: of what one frame saw, or three.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import closing
import json
from pathlib import Path
from time import perf_counter
from typing import Any

from common import (
    BUNNY,
    bunny_views,
    Clock,
    found,
    frames,
    KITCHEN_SWEEP,
    machine,
    say_absent,
    table,
)
import numpy as np
from numpy.typing import NDArray
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector
from truth import Geometry, Truth
import tsdf

from gr2t_ros.core.fused_mesh import SurfaceMesh
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.settings import Settings
from gr2t_ros.tools.evaluate import nause
from gr2t_ros.tools.noise import Noise

BUNNY_SETTINGS = Settings(
    depth_bandwidth=0.001, depth_bandwidth_quadratic=0.0, keyframe_translation=0.0)
# the defaults' h3 = 3 mm + 2 mm z^2, which the lattice holds above 1 cm
KITCHEN_SETTINGS = Settings(voxel_size=0.01, depth_max=3.5)
TSDF_WEIGHTS = {'TSDF': 0.5, 'TSDF >= 3': 2.5}  # surface that one frame saw, or three
Row = dict[str, Any]
_EVERY = 4  # px between the rays that count layers
_MOST = 60.0  # degrees from the normal of the surface that they meet


def main() -> None:
    """Measure and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--data', type=Path, default=Path('../shared/data'), help='its folder')
    parser.add_argument('--only', choices=('bunny', 'kitchen'))
    parser.add_argument('--frames', type=int, default=100, help='of the kitchen (100)')
    parser.add_argument('--json', metavar='FILE', help='also write the figures there')
    arguments = parser.parse_args()
    say_absent(arguments.data)
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, load {about["load"]:.1f}; kernels ready '
          f'in {warm_up(KITCHEN_SETTINGS):.1f} s', flush=True)
    if not tsdf.installed():
        print('Open3D is not installed: no TSDF')
    results: dict[str, Any] = {'machine': about}
    if arguments.only != 'kitchen':
        results['bunny'] = bunny(found(arguments.data, BUNNY))
    if arguments.only != 'bunny':
        results['kitchen'] = kitchen(
            frames(arguments.data, KITCHEN_SWEEP, arguments.frames, KITCHEN_SETTINGS))
    if arguments.json:
        with open(arguments.json, 'w', encoding='utf-8') as file:
            json.dump(results, file, indent=1)


def bunny(path: Path | None) -> list[Row]:
    """Measure the simulated views."""
    rows: list[Row] = []
    if path is None:
        return rows
    mesh = trimesh.load_mesh(path)
    for outliers in (0.0, 0.05):
        views = bunny_views(mesh, Noise('gaussian', sigma=0.001, outliers=outliers))
        truth = Truth(mesh, views)
        for voxel in (0.001, 0.002):
            about = {'outliers': f'{100 * outliers:g} %', 'voxel mm': 1e3 * voxel}
            clock = Clock()
            fused, fuse_s = _fused(views, BUNNY_SETTINGS.updated({'voxel_size': voxel}))
            geometry = Geometry(fused.vertices, fused.faces)
            off = truth.surface.distances(fused.vertices)
            rows.append({'map': 'fused', **about, **_against(truth, geometry, views),
                         's': fuse_s, 'NAUSE confidence': nause(off, fused.vertex_confidence)})
            if tsdf.installed():
                grid = tsdf.Tsdf(voxel, BUNNY_SETTINGS.depth_max)
                for view in views:
                    clock('tsdf', grid.integrate, tsdf.Frame(view))
                for name, weight in TSDF_WEIGHTS.items():
                    theirs = clock(name, grid.mesh, weight)
                    rows.append({
                        'map': name, **about,
                        **_against(truth, Geometry(theirs.vertices, theirs.faces), views),
                        's': clock.seconds['tsdf'] + clock.seconds[name],
                        'NAUSE confidence': None})
    table('bunny, 12 views, sigma 1 mm, h3 1 mm; distances in mm', rows)
    return rows


def _fused(views: Sequence[View], settings: Settings) -> tuple[SurfaceMesh, float]:
    """Return the fused mesh of the views, and what it took beside the marching, seconds."""
    with closing(Reconstruction(settings)) as reconstruction:
        for view in views:
            reconstruction.add(view)
        reconstruction.finish()
        began = perf_counter()
        mesh = reconstruction.fused_mesh()
        return mesh, perf_counter() - began


def _against(truth: Truth, mesh: Geometry, views: Sequence[View]) -> Row:
    distance = 1e3 * truth.surface.distances(mesh.vertices)
    return {
        'mean': float(distance.mean()), '95 %': float(np.percentile(distance, 95)),
        'complete .5 %': 100 * truth.completeness(mesh, 0.0005),
        '1 mm %': 100 * truth.completeness(mesh, 0.001),
        'layers %': 100 * layers(mesh, views, 0.003), **shape(mesh)}


def layers(mesh: Geometry, views: Sequence[View], within: float) -> float:
    """Return how many further faces the views' rays meet near their first; see above."""
    middle = mesh.vertices.mean(axis=0)
    solid = trimesh.Trimesh(mesh.vertices - middle, mesh.faces, process=False)
    caster, normals = RayMeshIntersector(solid), solid.face_normals
    extra = rays = 0
    for view in views:
        R, eye = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3] - middle
        slopes = view.camera.rays[::_EVERY, ::_EVERY].reshape(-1, 2)
        directions = np.column_stack([slopes, np.ones(len(slopes))]) @ R.T
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        places, ray, face = caster.intersects_location(
            np.broadcast_to(eye, directions.shape), directions, multiple_hits=True)
        away = np.linalg.norm(places - eye, axis=1)
        order = np.lexsort((away, ray))
        ray, face, away = ray[order], face[order], away[order]
        first = np.flatnonzero(np.diff(ray, prepend=-1))
        cosine = -np.einsum('ij,ij->i', normals[face], directions[ray])
        counted = cosine[first] > np.cos(np.radians(_MOST))
        of = np.repeat(np.arange(len(first)), np.diff(first, append=len(ray)))
        near = (cosine > 0) & (away - away[first][of] <= within) & counted[of]
        extra += int(near.sum()) - int(counted.sum())
        rays += int(counted.sum())
    return extra / max(rays, 1)


def shape(mesh: Geometry) -> Row:
    """Return how the faces hang together."""
    edges = np.sort(np.concatenate([
        mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(
        edges[:, 0].astype(np.int64) * len(mesh.vertices) + edges[:, 1], return_counts=True)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    parts = trimesh.graph.connected_components(
        solid.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1)
    return {
        'edges > 2': int(np.sum(counts > 2)), 'border edges': int(np.sum(counts == 1)),
        'parts': len(parts), 'faces': len(mesh.faces)}


def kitchen(views: Sequence[View]) -> Row:
    """Measure a real recording, fused after each frame, and fused once."""
    if not views:
        return {}
    rows: list[Row] = []
    with closing(Reconstruction(KITCHEN_SETTINGS)) as steps:
        costs = [_update(steps, view) for view in views]
        steps.finish()
        one = steps.fused_mesh()
    with closing(Reconstruction(KITCHEN_SETTINGS)) as whole:
        for view in views:
            whole.add(view)
        whole.finish()
        clock = Clock()
        clock('fuse', whole.fuse)
        other = clock('mesh', whole.fused_mesh)
        fused_mb = 1e-6 * whole.fused.nbytes
        keyframes = len(whole.keyframes)
    rows.append({'map': 'fused', **_rough(Geometry(other.vertices, other.faces), views)})
    if tsdf.installed():
        grid = tsdf.Tsdf(KITCHEN_SETTINGS.voxel_size, KITCHEN_SETTINGS.depth_max)
        for view in views:
            clock('tsdf', grid.integrate, tsdf.Frame(view))
        for name, weight in TSDF_WEIGHTS.items():
            theirs = clock(name, grid.mesh, weight)
            rows.append({'map': name, **_rough(Geometry(theirs.vertices, theirs.faces), views)})
    table(f'{KITCHEN_SWEEP}, {len(views)} frames, {keyframes} keyframes, voxel 1 cm', rows)
    table('the whole, s', [{
        name: clock.seconds[name] for name in clock.seconds} | {
            'CPU s of fuse': clock.cpu['fuse'], 'fused MB': fused_mb}])
    update = {
        f'{name} ms, {kind}': 1e3 * float(function([cost[name] for cost in costs]))
        for name in ('fuse', 'CPU', 'regions') for kind, function in (
            ('p50', np.median), ('p95', lambda values: np.percentile(values, 95)))}
    update['regions changed'] = float(np.median([cost['count'] for cost in costs]))
    table('after each frame', [update])
    same = equal(one, other)
    print(f'fused frame by frame, and once: {"equal bit for bit" if same else "DIFFERENT"}')
    return {'meshes': rows, 'seconds': clock.seconds, 'fused MB': fused_mb, 'update': update,
            'equal': same}


def _update(reconstruction: Reconstruction, view: View) -> dict[str, float]:
    """Add a view, and return what it cost to bring the fused map and its regions up to date."""
    reconstruction.add(view)
    clock = Clock()
    changed = clock('fuse', reconstruction.fuse)
    for region in changed:
        clock('regions', reconstruction.fused_region, region)
    return {'fuse': clock.seconds['fuse'], 'CPU': clock.cpu['fuse'],
            'regions': clock.seconds.get('regions', 0.0), 'count': float(len(changed))}


def _rough(mesh: Geometry, views: Sequence[View]) -> Row:
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    angles = np.degrees(solid.face_adjacency_angles)
    return {
        'layers %': 100 * layers(mesh, views[::5], 3 * KITCHEN_SETTINGS.voxel_size),
        'angle p50': float(np.median(angles)), 'angle p90': float(np.percentile(angles, 90)),
        **shape(mesh)}


def equal(one: SurfaceMesh, other: SurfaceMesh) -> bool:
    """Tell whether two meshes are the same but for the order of what they hold."""
    return all(np.array_equal(a, b) for a, b in zip(_in_order(one), _in_order(other)))


def _in_order(mesh: SurfaceMesh) -> list[NDArray[Any]]:
    order = np.lexsort(mesh.vertices.T)
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    faces = number[mesh.faces]
    turn = (np.arange(3) + faces.argmin(axis=1)[:, None]) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    return [
        mesh.vertices[order], mesh.vertex_likelihood[order], mesh.vertex_sigma[order],
        mesh.vertex_confidence[order], mesh.vertex_views[order], faces[np.lexsort(faces.T)]]


if __name__ == '__main__':
    main()
