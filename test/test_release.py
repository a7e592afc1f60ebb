# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Memory has a bound: what leaves is finished and handed out, what stays is as without a bound."""
from contextlib import closing

import numpy as np
import pytest
from scenes_for_tests import plane_view, pose

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.colour import Colouring
from gr2t_ros.core.ray_march import Rays
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.release import BYTES_PER_RAY, limit_of, used_by
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.errors import FrameError, Gr2tError
from gr2t_ros.settings import Settings

SETTINGS = Settings(
    depth_bandwidth=0.01, depth_bandwidth_quadratic=0.0, voxel_size=0.01, depth_max=0.8,
    keyframe_translation=0.15, max_memory_mb=18, threads=2)
CAMERA = Camera(160, 120, 180.0, 180.0, 79.5, 59.5)


def along_a_wall(count: int) -> list:
    """Return views of a wall along which the camera moves."""
    return [
        plane_view(CAMERA, pose([0, 0, 0], [0.1 * i, 0, 0]), [0, 0, 1], 0.5) for i in range(count)]


class Disk:
    """Keeps what it is given, or is full."""

    def __init__(self) -> None:
        self.meshes: dict[int, ViewMesh] = {}
        self.full = False

    def __call__(self, number: int, mesh: ViewMesh, colouring: Colouring) -> None:
        if self.full:
            raise Gr2tError('cannot write part.ply: No space left on device')
        assert colouring.scale > 0
        self.meshes[number] = mesh


def run(views: list, settings: Settings, disk: Disk) -> tuple[Reconstruction, list]:
    reconstruction = Reconstruction(settings, disk)
    return reconstruction, [reconstruction.add(view) for view in views]


def test_what_leaves_is_handed_out_and_what_stays_is_as_without_a_bound() -> None:
    disk, views = Disk(), along_a_wall(100)
    bounded, updates = run(views, SETTINGS, disk)
    free, _ = run(views, SETTINGS.updated({'max_memory_mb': 10_000}), Disk())
    with closing(bounded), closing(free):
        released = [number for update in updates for number in update.released]
        assert len(released) > 10 and released == list(disk.meshes)
        assert released == sorted(released), 'the farthest first'
        assert bounded.kept == len(bounded.keyframes) - len(released)
        assert used_by(bounded) < used_by(free) / 2
        assert all('release' in update.seconds for update in updates if update.released)
        bounded.finish()
        free.finish()
        assert bounded.blocks < free.blocks / 2
        for number, (ours, theirs) in enumerate(zip(bounded.keyframes, free.keyframes)):
            np.testing.assert_array_equal(ours.view.T_world_camera, theirs.view.T_world_camera)
            mesh, expected = bounded.mesh(number), free.mesh(number)
            if number in disk.meshes:
                assert ours.released and not len(mesh.vertices)
                # finished: all that saw it had come
                mesh = disk.meshes[number]
            else:
                np.testing.assert_array_equal(ours.rays.depth, theirs.rays.depth)
                np.testing.assert_array_equal(ours.rays.total, theirs.rays.total)
                np.testing.assert_array_equal(mesh.edge_likelihood, expected.edge_likelihood)
            np.testing.assert_array_equal(mesh.vertices, expected.vertices)
            np.testing.assert_array_equal(mesh.faces, expected.faces)


def test_memory_stays_within_the_bound() -> None:
    with closing(Reconstruction(SETTINGS, Disk())) as reconstruction:
        reconstruction.add(along_a_wall(1)[0])
        one = used_by(reconstruction)
        for view in along_a_wall(60):
            reconstruction.add(view)
            assert used_by(reconstruction) < limit_of(SETTINGS) + one


@pytest.mark.parametrize(('density', 'limit'), [('voxel', 18), ('exact', 24)])
def test_a_full_disk_loses_nothing(density: str, limit: int) -> None:
    """Frames are refused while there is no room, and accepted when there is."""
    disk = Disk()
    settings = SETTINGS.updated({'density': density, 'max_memory_mb': limit})
    with closing(Reconstruction(settings, disk)) as reconstruction:
        disk.full = True
        refused = []
        for view in along_a_wall(60):
            keyframes = len(reconstruction.keyframes)
            size = reconstruction.density.size if keyframes else 0
            try:
                reconstruction.add(view)
            except FrameError as error:
                refused.append(error)
                assert len(reconstruction.keyframes) == keyframes
                assert reconstruction.density.size == size
        assert {error.reason for error in refused} == {'memory'}
        assert all('No space left' in str(error) for error in refused)
        assert reconstruction.kept == len(reconstruction.keyframes)
        disk.full = False
        reconstruction._bound._again = 0.0
        update = reconstruction.add(along_a_wall(60)[-1])
        assert update.released == tuple(disk.meshes) and disk.meshes


def test_a_bound_below_one_view_is_said() -> None:
    with closing(Reconstruction(SETTINGS.updated({'max_memory_mb': 1}), Disk())) as small:
        views = along_a_wall(2)
        small.add(views[0])
        with pytest.raises(FrameError, match='max_memory_mb allows 1: raise it') as error:
            small.add(views[1])
        assert error.value.reason == 'memory'


def test_max_keyframes_sends_the_far_ones_away() -> None:
    """Those near the camera stay, and then views own no mesh."""
    settings = SETTINGS.updated({'max_keyframes': 12, 'max_memory_mb': 10_000})
    disk = Disk()
    path = along_a_wall(60)
    near, _ = run(path[:20], settings, disk)
    assert not disk.meshes
    near.close()
    far, updates = run(path, settings, disk)
    assert disk.meshes and far.kept == 12
    assert far.keyframes[-1].view.T_world_camera[0, 3] > 5.5
    far.close()
    without, updates = run(path, settings.updated({'depth_max': 40.0}), disk)
    assert without.kept == len(without.keyframes) == 12
    assert any('max_keyframes' in notice for update in updates for notice in update.notices)
    without.close()


def test_without_a_sink_there_is_no_bound() -> None:
    with closing(Reconstruction(SETTINGS.updated({'max_memory_mb': 1}))) as reconstruction:
        for view in along_a_wall(3):
            assert reconstruction.add(view).released == ()


def test_a_frozen_map_keeps_what_leaves_meanwhile() -> None:
    views = along_a_wall(60)
    reconstruction, _ = run(views[:12], SETTINGS, Disk())
    with closing(reconstruction):
        reconstruction.finish()
        expected = reconstruction.mesh(0)
        frozen = reconstruction.frozen({})
        for view in views[12:]:
            reconstruction.add(view)
        assert reconstruction.keyframes[0].released
        frozen.finish()
        np.testing.assert_array_equal(frozen.mesh(0).vertices, expected.vertices)


def test_a_ray_s_bytes_are_those_of_its_arrays() -> None:
    with closing(Reconstruction(SETTINGS)) as reconstruction:
        reconstruction.add(along_a_wall(1)[0])
        rays: Rays = reconstruction.keyframes[0].rays
        each = [value.nbytes for name, value in vars(rays).items()
                if name not in ('table', 'T_world_camera', 'rounds')]
        assert sum(each) == BYTES_PER_RAY * len(rays.pixels)
