# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Two maps of one world, summed, are the map of one run over the views of both."""
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
import json
from pathlib import Path

import bags_for_tests as bags
import numpy as np
import pytest
from scenes_for_tests import bumpy_views, plane_view, pose
from scipy.spatial import cKDTree
from test_map_file import assert_same_state, built, kitchen

from gr2t_ros.core.blocks import VOXELS
from gr2t_ros.core.camera import Camera
from gr2t_ros.core.merge import add_map
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.errors import InputError
from gr2t_ros.io import formats
from gr2t_ros.io.map_file import MapFile
from gr2t_ros.settings import Settings
from gr2t_ros.tools import cli

SETTINGS = Settings(
    depth_bandwidth=0.004, keyframe_translation=0.0, threads=2, voxel_size=0.005,
    remarch_budget=0.0)
EXACT = SETTINGS.updated({'density': 'exact'})


def stamped(views: list[View]) -> list[View]:
    return [replace(view, stamp_ns=1000 + n) for n, view in enumerate(views)]


def merged(first: list[View], second: list[View], settings: Settings) -> Reconstruction:
    ours = built(first, settings)
    add_map(ours, built(second, settings))
    ours.finish()
    return ours


def samples(reconstruction: Reconstruction, name: str) -> dict[int, np.ndarray]:
    """Return a field of the lattice by the keys of its blocks."""
    density = reconstruction.density
    assert isinstance(density, VoxelDensity)
    size = density.blocks.size
    return dict(zip(
        density.blocks.key[1:size].tolist(),
        getattr(density.blocks, name)[VOXELS:VOXELS * size].reshape(-1, VOXELS)))


def test_the_exact_density_is_the_same_bit_for_bit() -> None:
    views = stamped(bumpy_views() + bumpy_views(1))
    whole = built(views, EXACT)
    whole.finish()
    both = merged(views[:3], views[3:], EXACT)
    for keyframe in (*both.keyframes, *whole.keyframes):
        keyframe.checked = keyframe.rays.marched[:] = whole.density.change
    assert_same_state(both, whole)


def assert_same_meshes(ours: Reconstruction, theirs: Reconstruction) -> None:
    assert len(ours.keyframes) == len(theirs.keyframes)
    for (_, a), (_, b) in zip(ours.meshes(), theirs.meshes()):
        for name in vars(a):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_the_lattice_differs_by_roundings_elsewhere() -> None:
    """Sums in another order: no more than a rounding for each view, and so do the meshes."""
    views = stamped(bumpy_views() + bumpy_views(1) + bumpy_views(2))
    whole = built(views, SETTINGS)
    whole.finish()
    assert_close(merged(views[:6], views[6:], SETTINGS), whole, len(views))


def test_two_parts_of_a_recording(data: Path) -> None:
    settings = Settings(ray_stride=4, keyframe_translation=0.0, voxel_size=0.02)
    views = list(islice(kitchen(data, settings), 12))
    whole = built(views, settings)
    whole.finish()
    assert_close(merged(views[:6], views[6:], settings), whole, len(views))


def assert_close(both: Reconstruction, whole: Reconstruction, count: int) -> None:
    for name in ('value', 'expected'):
        a, b = samples(both, name), samples(whole, name)
        assert a.keys() == b.keys()
        ours, theirs = (np.concatenate([item[key] for key in sorted(a)]) for item in (a, b))
        np.testing.assert_allclose(ours, theirs, rtol=count * 2.0 ** -24, atol=1e-30)
    assert both.density.size == whole.density.size
    assert len(both.keyframes) == len(whole.keyframes)
    for ours, theirs in zip(both.keyframes, whole.keyframes):
        np.testing.assert_array_equal(ours.rays.pixels, theirs.rays.pixels)
        same = ours.rays.converged & theirs.rays.converged
        assert same.mean() > 0.999 * max(theirs.rays.converged.mean(), 0.1)
        difference = np.abs(ours.rays.depth - theirs.rays.depth)[same]
        assert np.quantile(difference, 0.999) < 1e-5  # metres


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
def test_only_rays_where_both_are_wait(settings: Settings) -> None:
    """Those of the first map that the second does not touch keep what was found."""
    camera = Camera(40, 30, 80.0, 80.0, 19.5, 14.5)
    here, there, beside = stamped([
        plane_view(camera, pose([0, 0, 0], [x, 0, 0]), [0, 0, 1], 0.5) for x in (0, 1, 0.12)])
    apart, overlapping = built([here], settings), built([here], settings)
    add_map(apart, built([there], settings))
    add_map(overlapping, built([beside], settings))
    assert apart.finish().remarched == 1200
    assert 1200 < overlapping.finish().remarched < 2400
    whole = built([here, there], settings)
    whole.finish()
    assert_same_meshes(apart, whole)
    if settings == SETTINGS:
        for name in ('value', 'expected'):
            a, b = samples(apart, name), samples(whole, name)
            assert a.keys() == b.keys()
            assert all((a[key] == b[key]).all() for key in a)


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
def test_it_goes_on(settings: Settings) -> None:
    views = stamped(bumpy_views())
    both = merged(views[:1], views[1:2], settings)
    whole = built(views[:2], settings)
    for item in (both, whole):
        item.add(views[2])
        item.finish()
    assert both.stamp_ns == whole.stamp_ns
    if settings == EXACT:
        assert_same_meshes(both, whole)
    else:
        assert_close(both, whole, 3)


def test_what_does_not_fit_together() -> None:
    views = stamped(bumpy_views())
    ours = built(views[:1], SETTINGS)
    for values, words in (
            ({'density': 'exact'}, 'density is voxel and exact'),
            ({'voxel_size': 0.004}, 'voxel_size is 0.005 and 0.004'),
            ({'pixel_bandwidth': 2.0, 'depth_bandwidth': 0.005},
             'pixel_bandwidth is 1.5 and 2.0, depth_bandwidth is 0.004 and 0.005')):
        with pytest.raises(InputError, match=words):
            add_map(ours, built(views[1:2], SETTINGS.updated(values)))
    with pytest.raises(InputError, match=r'both hold the view of 0\.000 s'):
        add_map(ours, built(views, SETTINGS))


@pytest.fixture
def replay(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that replays a recording of a wall, and keeps the map."""
    bag = bags.write(tmp_path / 'scan', bags.scan(8))

    def run(name: str, *arguments: str) -> Path:
        folder = tmp_path / name
        assert cli.main([
            'replay', str(bag), '-o', str(folder), '--save-map', '-p', 'keyframe_translation:=0.0',
            '-p', 'voxel_size:=0.01', *arguments]) == 0
        return folder

    return run


def test_maps_of_two_replays(replay: Callable[..., Path], tmp_path: Path) -> None:
    """The folders will do; the result holds a map too, whose mesh is what was written."""
    first = replay('first', '--max-frames', '5')
    second = replay('second', '--start', '0.48')
    assert MapFile(first / 'map.gr2t').views == 5
    out = tmp_path / 'both'
    assert cli.main(['merge', str(first), str(second / 'map.gr2t'), '-o', str(out)]) == 0
    whole = replay('whole')
    assert MapFile(out / 'map.gr2t').views == MapFile(whole / 'map.gr2t').views == 8
    ours, theirs = (formats.read(item / 'mesh.ply') for item in (out, whole))
    # but for the order in which the sums were rounded, which may decide whether a face stays
    assert len(ours.faces) == pytest.approx(len(theirs.faces), rel=0.001)
    apart, _ = cKDTree(theirs.vertices).query(ours.vertices)
    assert np.quantile(apart, 0.99) < 2e-6
    again = tmp_path / 'again'
    assert cli.main(['merge', str(out), '-o', str(again), '--per-view']) == 0
    assert (again / 'mesh.ply').read_bytes() == (out / 'mesh.ply').read_bytes()
    assert len(list((again / 'views').iterdir())) == 8
    assert json.loads((again / 'report.json').read_text())['frames']['integrated'] == 8


def test_maps_that_cannot_be_merged(
    replay: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = replay('first', '--max-frames', '2')
    arguments = ['-o', str(tmp_path / 'out')]
    for other, words in (
            (replay('same'), 'both hold the view of'),
            (replay('frame', '--world-frame', 'camera_link'), "world frame 'camera_link'"),
            (replay('coarse', '-p', 'voxel_size:=0.02'), 'voxel_size is 0.01 and 0.02'),
            (tmp_path, 'No such file')):
        assert cli.main(['merge', str(first), str(other), *arguments]) == 2
        error = capsys.readouterr().err
        assert words in error.splitlines()[-1] and 'map.gr2t' in error.splitlines()[-1]
    assert not (tmp_path / 'out' / 'map.gr2t').exists()
