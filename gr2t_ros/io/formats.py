# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Meshes in the formats of other programs, read and written through trimesh."""
from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from ..errors import Gr2tError, InputError
from . import ply
from .files import whole_file

# what a mesh of this package says of its vertices, where a file holds it
ATTRIBUTES = ('likelihood', 'sigma', 'confidence', 'views', 'view')
# file ending -> what the format cannot hold
WRITTEN = {
    '.ply': '',
    '.glb': '',
    '.obj': 'OBJ files hold colours, but no likelihood, sigma and confidence',
    '.stl': 'STL files hold the surface alone: no colours, likelihood, sigma and confidence'}
_LARGEST = float(np.finfo(np.float32).max)
_Y_UP = ('.glb', '.gltf')  # glTF has y up, and linear colours; this package z up, as REP 103


@dataclass(frozen=True, eq=False)
class Mesh:
    """
    A mesh of triangles as any file may hold it.

    :param vertices: (n, 3) float64, metres, z up
    :param faces: (m, 3) int32, indices of vertices
    :param colours: (n, 3) uint8, red green blue; None where it has none
    :param attributes: of ATTRIBUTES those that it has, (n,) float32 each
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    colours: NDArray[np.uint8] | None = None
    attributes: dict[str, NDArray[np.float32]] = field(default_factory=dict)


def read(path: Path) -> Mesh:
    """
    Read a mesh of any format that trimesh reads; its coordinates stay, but z is up.

    :raises InputError: if it cannot be read or has no triangles
    """
    if not path.is_file():
        raise InputError(f'there is no mesh {path}')
    try:
        found = _loaded(path)
    except Exception as error:  # trimesh's readers raise whatever their libraries do
        raise InputError(
            f'{path} cannot be read as a mesh ({type(error).__name__}: {error})') from error
    if not isinstance(found, trimesh.Trimesh) or len(found.faces) == 0:
        raise InputError(f'{path} has no triangles')
    if found.faces.min() < 0 or found.faces.max() >= len(found.vertices):
        raise InputError(f'{path} has triangles of vertices that it does not hold')
    if not np.isfinite(found.vertices).all():
        raise InputError(f'{path} has vertices that are not finite')
    vertices, colours = np.array(found.vertices, np.float64), _colours(found)
    if path.suffix.lower() in _Y_UP:
        x, y, z = vertices.T
        vertices = np.column_stack([x, -z, y])
        colours = None if colours is None else _gamma(colours, 1 / 2.4)
    return Mesh(vertices, np.array(found.faces, np.int32), colours, _attributes(found))


def _loaded(path: Path) -> Any:
    ending = path.suffix.lower()
    if ending in _Y_UP:
        scene: Any = trimesh.load(path, process=False)
        parts = scene.graph.nodes_geometry
        if len(parts) == 1:  # joining several loses colours beside a material
            T_scene_part, name = scene.graph[parts[0]]
            return scene.geometry[name].apply_transform(T_scene_part)
    mesh = trimesh.load_mesh(path, process=False)
    if ending == '.stl':  # each triangle has corners of its own there
        mesh.merge_vertices()
    return mesh


def _colours(mesh: Any) -> NDArray[np.uint8] | None:
    if isinstance(mesh.visual, TextureVisuals):
        colours = mesh.visual.vertex_attributes.get('color')
    else:
        colours = mesh.visual.vertex_colors if mesh.visual.kind == 'vertex' else None
    return None if colours is None else np.array(colours, np.uint8)[:, :3]


def _attributes(mesh: Any) -> dict[str, NDArray[np.float32]]:
    """Return what a file says of its vertices."""
    vertex = mesh.metadata.get('_ply_raw', {}).get('vertex', {}).get('data')
    found = {}
    for name in ATTRIBUTES:
        try:
            values = mesh.vertex_attributes.get(f'_{name.upper()}')  # as glTF wants them named
            values = np.array(vertex[name] if values is None else values, np.float32).reshape(-1)
        except (IndexError, KeyError, TypeError, ValueError):
            continue
        if len(values) == len(mesh.vertices):
            found[name] = np.where(values == _LARGEST, np.float32(np.inf), values)
    return found


def check_ending(path: Path) -> None:
    """
    Raise if no format that can be written has a file's ending.

    :raises InputError: with the endings that can
    """
    if path.suffix.lower() not in WRITTEN:
        raise InputError(
            f'{path} must end in {", ".join(list(WRITTEN)[:-1])} or {list(WRITTEN)[-1]}: the '
            'ending says the format')


def write(path: Path, mesh: Mesh) -> None:
    """
    Write a mesh in the format that the file's ending names.

    Colours and attributes are written where the format holds them.

    :raises InputError: for another ending than those of WRITTEN
    :raises Gr2tError: if the file cannot be written
    """
    check_ending(path)
    ending, vertices, colours = path.suffix.lower(), mesh.vertices, mesh.colours
    if ending == '.ply':
        ply.write_mesh(path, vertices, mesh.faces, colours, mesh.attributes)
        return
    visual: Any = None
    attributes: dict[str, NDArray[np.float32]] = {}
    if ending in _Y_UP:
        x, y, z = vertices.T
        vertices = np.column_stack([x, z, -y])
        attributes = {  # which must be finite there
            f'_{name.upper()}': np.nan_to_num(values, nan=_LARGEST)
            for name, values in mesh.attributes.items()}
        visual = _double_sided(colours)
    elif colours is not None:
        visual = ColorVisuals(vertex_colors=colours)
    content: Any = trimesh.Trimesh(
        vertices, mesh.faces, visual=visual, vertex_attributes={**attributes},
        process=False,
    ).export(file_type=ending[1:])
    with whole_file(path) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


def _double_sided(colours: NDArray[np.uint8] | None) -> Any:
    """Return how glTF viewers show a mesh: from both sides, and not as metal, their default."""
    material: Any = PBRMaterial
    visual: Any = TextureVisuals
    found = visual(material=material(
        metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True))
    if colours is not None:
        opaque = np.full((len(colours), 1), 255, np.uint8)
        found.vertex_attributes['color'] = np.hstack([_gamma(colours, 2.4), opaque])
    return found


def _gamma(colours: NDArray[np.uint8], exponent: float) -> NDArray[np.uint8]:
    """
    Take colours from sRGB to linear light (exponent 2.4) or back (1 / 2.4).

    IEC 61966-2-1.
    """
    level = np.arange(256) / 255.0
    if exponent > 1:
        table = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** exponent)
    else:
        table = np.where(level <= 0.0031308, level * 12.92, 1.055 * level ** exponent - 0.055)
    found: NDArray[np.uint8] = np.round(255 * table).astype(np.uint8)[colours]
    return found


def decimated(mesh: Mesh, max_faces: int) -> Mesh:
    """
    Return a mesh of no more faces; its vertices carry what the nearest of the old ones did.

    By quadric error metrics (Garland & Heckbert 1997), through the library fast-simplification.

    :raises Gr2tError: if that library is missing
    """
    if len(mesh.faces) <= max_faces:
        return mesh
    try:
        found = trimesh.Trimesh(
            mesh.vertices, mesh.faces, process=False,
        ).simplify_quadric_decimation(face_count=max_faces)
    except ImportError as error:
        raise Gr2tError('fewer faces need a library: pip install fast-simplification') from error
    nearest = cKDTree(mesh.vertices).query(found.vertices)[1]
    return Mesh(
        np.array(found.vertices, np.float64), np.array(found.faces, np.int32),
        None if mesh.colours is None else mesh.colours[nearest],
        {name: values[nearest] for name, values in mesh.attributes.items()})
