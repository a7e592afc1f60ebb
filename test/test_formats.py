# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A mesh keeps its place, colours and likelihoods on its way through other programs' formats."""
import json
from pathlib import Path
import struct
from typing import Any

import numpy as np
import pytest
import trimesh

from gr2t_ros.errors import Gr2tError, InputError
from gr2t_ros.io import formats


def surface() -> formats.Mesh:
    """Return a ball beside the origin whose vertices all differ in what they carry."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.apply_translation((1.0, 2.0, 3.0))
    n = len(ball.vertices)
    rng = np.random.default_rng(0)
    return formats.Mesh(
        np.array(ball.vertices, np.float64), np.array(ball.faces, np.int32),
        rng.integers(0, 256, (n, 3), np.uint8),
        {'likelihood': np.linspace(1e-6, 2e-6, n, dtype=np.float32),
         'sigma': np.linspace(1e-4, 2e-3, n, dtype=np.float32),
         'confidence': np.linspace(0.2, 0.9, n, dtype=np.float32),
         'views': np.arange(n, dtype=np.float32) % 13})


def solid(mesh: formats.Mesh) -> trimesh.Trimesh:
    """Return what can be measured."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize('ending', formats.WRITTEN)
def test_what_is_written_is_read_back(ending: str, tmp_path: Path) -> None:
    mesh = surface()
    path = tmp_path / f'mesh{ending.upper()}'
    formats.write(path, mesh)
    found = formats.read(path)
    assert list(tmp_path.iterdir()) == [path]  # OBJ comes without a material's file
    if ending == '.stl':  # its corners are joined again, in another order
        assert len(found.vertices) == len(mesh.vertices)
        assert solid(found).is_watertight
        np.testing.assert_allclose(solid(found).bounds, solid(mesh).bounds, rtol=1e-6)
        return
    np.testing.assert_allclose(found.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    # linear bytes, which glTF wants, tell dark colours less well apart
    off = np.abs(np.subtract(found.colours, mesh.colours, dtype=int))
    assert off.max() <= (6 if ending == '.glb' else 0)
    if ending == '.obj':
        return
    assert set(found.attributes) == set(mesh.attributes)
    for name in mesh.attributes:
        np.testing.assert_array_equal(
            found.attributes[name], mesh.attributes[name], name)


def gltf(path: Path) -> dict[str, Any]:
    """Return the JSON of a GLB file, read by what the standard says of it."""
    content = path.read_bytes()
    magic, version, length, size, kind = struct.unpack('<4sIII4s', content[:20])
    assert (magic, version, length, kind) == (b'glTF', 2, len(content), b'JSON')
    found: dict[str, Any] = json.loads(content[20:20 + size])
    return found


def test_a_glb_is_as_the_standard_has_it(tmp_path: Path) -> None:
    mesh = surface()
    formats.write(tmp_path / 'mesh.glb', mesh)
    found = gltf(tmp_path / 'mesh.glb')
    primitive = found['meshes'][0]['primitives'][0]
    colour = found['accessors'][primitive['attributes']['COLOR_0']]
    assert (colour['componentType'], colour['normalized'], colour['type']) == (5121, True, 'VEC4')
    place = found['accessors'][primitive['attributes']['POSITION']]
    low, high = solid(mesh).bounds  # y is up: what was z
    np.testing.assert_allclose(place['min'], (low[0], low[2], -high[1]), rtol=1e-6)
    np.testing.assert_allclose(place['max'], (high[0], high[2], -low[1]), rtol=1e-6)
    assert set(primitive['attributes']) == {
        'POSITION', 'COLOR_0', *(f'_{name.upper()}' for name in mesh.attributes)}
    material = found['materials'][primitive['material']]
    assert material['doubleSided']
    assert material['pbrMetallicRoughness']['metallicFactor'] == 0
    grey = surface()
    grey.colours[:] = 188  # half the light of white
    formats.write(tmp_path / 'grey.glb', grey)
    colour = gltf(tmp_path / 'grey.glb')['accessors'][primitive['attributes']['COLOR_0']]
    assert colour['max'][:3] == [pytest.approx(128, abs=1)] * 3


def test_what_is_not_finite_does_not_spoil_a_glb(tmp_path: Path) -> None:
    """JSON knows no infinity, and glTF allows none."""
    mesh = surface()
    mesh.attributes['sigma'][:3] = np.inf, np.nan, 0.001
    formats.write(tmp_path / 'mesh.glb', mesh)
    found = gltf(tmp_path / 'mesh.glb')
    assert all(np.isfinite(item['max']).all() for item in found['accessors'])
    np.testing.assert_array_equal(
        formats.read(tmp_path / 'mesh.glb').attributes['sigma'][:3],
        np.float32((np.inf, np.inf, 0.001)))


def test_open3d_reads_a_glb(tmp_path: Path) -> None:
    open3d = pytest.importorskip('open3d', exc_type=ImportError)
    mesh = surface()
    formats.write(tmp_path / 'mesh.glb', mesh)
    found = open3d.io.read_triangle_mesh(str(tmp_path / 'mesh.glb'))
    low, high = np.sort(np.asarray(found.vertices)[:, (0, 2, 1)] * (1, -1, 1), axis=0)[[0, -1]]
    np.testing.assert_allclose((low, high), solid(mesh).bounds, rtol=1e-5)
    assert len(found.triangles) == len(mesh.faces)
    assert found.has_vertex_colors()


def test_fewer_faces_keep_the_shape_and_what_it_carries() -> None:
    pytest.importorskip('fast_simplification')
    mesh = surface()
    mesh.attributes['likelihood'] = mesh.vertices[:, 0].astype(np.float32)
    found = formats.decimated(mesh, 400)
    assert len(found.faces) <= 400
    assert abs(solid(found).volume / solid(mesh).volume - 1) < 0.05
    assert set(found.attributes) == set(mesh.attributes)
    np.testing.assert_allclose(
        found.attributes['likelihood'], found.vertices[:, 0], atol=0.01)
    assert found.colours.shape == (len(found.vertices), 3)
    assert formats.decimated(mesh, len(mesh.faces)) is mesh


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__('sys').modules, 'fast_simplification', None)
    with pytest.raises(Gr2tError, match='pip install fast-simplification'):
        formats.decimated(surface(), 100)


def test_what_cannot_be_used_is_said(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'must end in \.ply, \.glb, \.obj or \.stl'):
        formats.write(tmp_path / 'mesh.xyz', surface())
    (tmp_path / 'text.ply').write_text('no mesh')
    formats.write(tmp_path / 'whole.ply', surface())
    (tmp_path / 'half.ply').write_bytes((tmp_path / 'whole.ply').read_bytes()[:-100])
    trimesh.PointCloud(np.zeros((3, 3))).export(tmp_path / 'points.ply')
    for name, sentence in (('none.glb', 'there is no mesh'), ('text.ply', 'cannot be read as a'),
                           ('half.ply', 'cannot be read as a'),
                           ('points.ply', 'no triangles|cannot be read')):
        with pytest.raises(InputError, match=sentence):
            formats.read(tmp_path / name)
    (tmp_path / 'mesh.glb').mkdir()
    with pytest.raises(Gr2tError, match='there is a folder of that name'):
        formats.write(tmp_path / 'mesh.glb', surface())
