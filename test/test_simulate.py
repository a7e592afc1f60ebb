# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated views and bags: exact depths, poses that survive, and files others can read."""
import sys

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
import trimesh

from gr2t_ros.errors import InputError
from gr2t_ros.io import trajectory
from gr2t_ros.tools import cli
from gr2t_ros.tools.noise import Noise
from gr2t_ros.tools.orbit import looking_at, orbit
from gr2t_ros.tools.ray_caster import RayCaster
from gr2t_ros.tools.recorder import record
from gr2t_ros.tools.scenes import tabletop, tabletop_poses
from gr2t_ros.tools.simulate import (
    fitting_distance,
    rendered_views,
    simulated_camera,
    simulated_views,
)

SMALL = {'width': 64, 'height': 48}


@pytest.fixture(scope='module')
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=0.1)


def _first_hits(mesh, T_world_camera, rays):
    """Intersect all rays with all triangles in double precision (Moeller and Trumbore)."""
    directions = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) @ T_world_camera[:3, :3].T
    a, b, c = np.moveaxis(np.asarray(mesh.triangles), 1, 0)
    p = np.cross(directions[:, None], c - a)
    det = np.sum((b - a) * p, axis=-1)
    s = T_world_camera[:3, 3] - a
    u = np.sum(s * p, axis=-1) / det
    q = np.cross(s, b - a)
    v = directions @ q.T / det
    t = np.sum((c - a) * q, axis=-1) / det
    t[(u < 0) | (v < 0) | (u + v > 1) | (t <= 0)] = np.inf
    depth = t.min(axis=1)
    return np.where(np.isfinite(depth), depth, np.nan)


def test_depth_is_along_the_optical_axis_and_not_the_range():
    box = trimesh.creation.box((2.0, 2.0, 0.2))
    T_world_camera = looking_at((0.0, 0.0, 1.1), (0.0, 0.0, 0.0))
    view, = simulated_views(box, poses=[T_world_camera], **SMALL)
    assert_allclose(view.depth, 1.0, rtol=1e-7)


def test_the_principal_point_is_the_middle_and_the_focal_length_scales_with_the_width():
    camera = simulated_camera(640, 480)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (525.0, 525.0, 319.5, 239.5)
    assert simulated_camera(320, 240).fx == 262.5


def test_depths_equal_a_search_over_all_triangles_in_double_precision(ball):
    camera = simulated_camera(64, 48)
    for T_world_camera in orbit((0, 0, 0), 0.35, 3):
        depth, _ = RayCaster(ball).cast(T_world_camera, camera.rays)
        expected = _first_hits(ball, T_world_camera, camera.rays.reshape(-1, 2))
        assert np.isfinite(expected).sum() > 300
        assert_allclose(depth.reshape(-1), expected, atol=1e-12, equal_nan=True)


def test_coordinates_far_from_the_origin_cost_no_accuracy(ball):
    camera = simulated_camera(64, 48)
    offset = np.array([4e5, 5e6, 100.0])
    T_world_camera = looking_at((0.3, 0.1, 0.2), (0, 0, 0))
    near, _ = RayCaster(ball).cast(T_world_camera, camera.rays)
    T_world_camera[:3, 3] += offset
    moved = ball.copy()
    moved.apply_translation(offset)
    far, _ = RayCaster(moved).cast(T_world_camera, camera.rays)
    assert_allclose(far, near, atol=2e-8, equal_nan=True)


def test_angles_are_those_between_rays_and_normals(ball):
    camera = simulated_camera(65, 49)
    depth, angle = RayCaster(ball).cast(looking_at((0.35, 0, 0), (0, 0, 0)), camera.rays)
    assert angle[24, 32] < 0.1
    assert 1.2 < np.nanmax(angle) <= np.pi / 2
    assert_array_equal(np.isnan(angle), np.isnan(depth))


def test_the_orbit_looks_at_the_centre_level_and_from_above_and_below():
    centre, poses = np.array([1.0, 2.0, 3.0]), orbit((1, 2, 3), 0.35, 12)
    elevations = []
    for T_world_camera in poses:
        R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
        assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
        assert_allclose(R.T @ (centre - eye), (0, 0, 0.35), atol=1e-12)
        assert abs(R[2, 0]) < 1e-12  # the image's rows are level
        assert R[2, 1] < 0  # and its top is up
        elevations.append(np.degrees(np.arcsin((eye - centre)[2] / 0.35)))
    assert max(elevations) > 45 and min(elevations) < -45
    assert len(np.unique(np.round(elevations))) > 6


def test_twelve_views_see_all_of_a_ball(ball):
    camera = simulated_camera(160, 120)
    points = np.concatenate([
        _points(view) for view in simulated_views(ball, 12, width=160, height=120)])
    assert len(points) > 12 * 2000
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    nearest = np.max(ball.face_normals @ directions.T, axis=1)
    assert nearest.min() > np.cos(np.deg2rad(4.0))
    assert camera.width == 160


def _points(view):
    """Return the world points of a view's valid pixels."""
    local = view.depth[..., None] * np.concatenate(
        [view.camera.rays, np.ones((*view.depth.shape, 1))], axis=-1)
    local = local[np.isfinite(view.depth)]
    return local @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]


def test_16uc1_depths_are_whole_millimetres(ball):
    exact, = simulated_views(ball, 1, **SMALL)
    coarse, = simulated_views(ball, 1, encoding='16UC1', **SMALL)
    valid = np.isfinite(exact.depth)
    assert_allclose(coarse.depth[valid] * 1000, np.round(exact.depth[valid] * 1000), atol=1e-4)
    assert np.abs(coarse.depth - exact.depth)[valid].max() <= 0.0005001


def test_kinect_noise_frays_silhouettes_and_depends_on_seed_and_image_alone(ball):
    poses = orbit((0, 0, 0), 0.35, 4)
    camera = simulated_camera(64, 48)
    first = list(rendered_views(ball, camera, poses, noise=Noise('kinect'), seed=3))
    again = list(rendered_views(ball, camera, poses[:2], noise=Noise('kinect'), seed=3))
    other = list(rendered_views(ball, camera, poses[:1], noise=Noise('kinect'), seed=4))
    assert_array_equal(first[1].depth, again[1].depth)
    assert not np.array_equal(first[0].depth, other[0].depth, equal_nan=True)
    clean = next(rendered_views(ball, camera, poses))
    frayed = np.isnan(clean.depth) != np.isnan(first[0].depth)
    assert 20 < frayed.sum() < 500


def test_a_bag_holds_the_images_the_camera_and_the_poses_exactly(ball, tmp_path):
    views = simulated_views(ball, 3, **SMALL)
    assert record(tmp_path / 'bag', views) == 3
    images, infos, tf, static = _read(tmp_path / 'bag')
    assert [t.child_frame_id for t in static] == [
        'camera_depth_frame', 'camera_depth_optical_frame']
    T_link_optical = _matrix(static[0].transform) @ _matrix(static[1].transform)
    for view, image, info, pose in zip(views, images, infos, tf, strict=True):
        assert _stamp(image) == _stamp(info) == _stamp(pose) == view.stamp_ns
        assert (image.encoding, image.step, image.header.frame_id) == (
            '32FC1', 4 * 64, 'camera_depth_optical_frame')
        assert_array_equal(image.data.view('<f4').reshape(48, 64), view.depth)
        assert_allclose(info.k.reshape(3, 3), [[52.5, 0, 31.5], [0, 52.5, 23.5], [0, 0, 1]])
        assert_allclose(info.p.reshape(3, 4)[:, :3], info.k.reshape(3, 3))
        assert (pose.header.frame_id, pose.child_frame_id) == ('map', 'camera_link')
        assert_allclose(
            _matrix(pose.transform) @ T_link_optical, view.T_world_camera, atol=1e-12)


def test_a_16uc1_bag_holds_millimetres_and_0_where_nothing_is_seen(ball, tmp_path):
    view, = simulated_views(ball, 1, encoding='16UC1', **SMALL)
    record(tmp_path / 'one.mcap', [view], '16UC1')
    assert (tmp_path / 'one.mcap').is_file()
    image = _read(tmp_path / 'one.mcap')[0][0]
    depth = image.data.view('<u2').reshape(48, 64)
    assert image.encoding == '16UC1'
    assert_array_equal(depth == 0, np.isnan(view.depth))
    assert_array_equal(depth, np.round(np.nan_to_num(view.depth) * 1000))


def _read(path):
    found = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            found.setdefault(connection.topic, []).append(
                reader.deserialize(raw, connection.msgtype))
    return (
        found['/camera/camera/depth/image_rect_raw'], found['/camera/camera/depth/camera_info'],
        [t for message in found['/tf'] for t in message.transforms],
        [t for message in found['/tf_static'] for t in message.transforms])


def _stamp(message):
    return message.header.stamp.sec * 10 ** 9 + message.header.stamp.nanosec


def _matrix(transform):
    T = np.eye(4)
    q = transform.rotation
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = transform.translation.x, transform.translation.y, transform.translation.z
    return T


def test_a_recording_that_fails_leaves_nothing_behind(ball, tmp_path):
    def views():
        yield from simulated_views(ball, 1, **SMALL)
        raise InputError('enough')

    with pytest.raises(InputError, match='enough'):
        record(tmp_path / 'bag', views())
    assert list(tmp_path.iterdir()) == []


def test_the_command_records_along_a_trajectory(ball, tmp_path, capsys):
    ball.export(tmp_path / 'ball.ply')
    poses = orbit((0, 0, 0), 0.4, 2)
    lines = ['# timestamp tx ty tz qx qy qz qw']
    for stamp, T_world_camera in zip((10.5, 11.25), poses, strict=True):
        numbers = *T_world_camera[:3, 3], *Rotation.from_matrix(T_world_camera[:3, :3]).as_quat()
        lines.append(' '.join([str(stamp), *(f'{number:.12f}' for number in numbers)]))
    (tmp_path / 'way.txt').write_text('\n'.join(lines))
    stamps, read = trajectory.read(tmp_path / 'way.txt')
    assert stamps == [10_500_000_000, 11_250_000_000]
    assert_allclose(read, poses, atol=1e-11)
    assert cli.main([
        'simulate', str(tmp_path / 'ball.ply'), str(tmp_path / 'bag'), '--width', '64',
        '--height', '48', '--trajectory', str(tmp_path / 'way.txt')]) == 0
    assert '2 images' in capsys.readouterr().out
    images, *_ = _read(tmp_path / 'bag')
    assert [_stamp(image) for image in images] == stamps
    expected = next(rendered_views(ball, simulated_camera(64, 48), poses))
    assert_allclose(
        images[0].data.view('<f4').reshape(48, 64), expected.depth, atol=1e-6, equal_nan=True)


def test_without_a_distance_the_cameras_see_all_of_the_mesh(ball):
    camera = simulated_camera(64, 48)
    for view in simulated_views(ball, 4, fitting_distance(ball, camera), **SMALL):
        seen = np.isfinite(view.depth)
        assert seen.any()
        assert not (seen[0].any() or seen[-1].any() or seen[:, 0].any() or seen[:, -1].any())


@pytest.mark.parametrize(('says', 'arguments'), [
    ('no mesh', ['nothing.ply', 'out']),
    ('cannot be read|no triangles', ['text.ply', 'out']),
    ('no triangles', ['points.ply', 'out']),
    ('ball.ply exists', ['ball.ply', 'ball.ply']),
    ('no image sees', ['ball.ply', 'out', '--distance', '1000']),
    ('number of views', ['ball.ply', 'out', '--views', '0']),
    ('distance', ['ball.ply', 'out', '--distance', '-1']),
    ('focal', ['ball.ply', 'out', '--focal', '0']),
    ('pixels', ['ball.ply', 'out', '--width', '0']),
    ('--sigma', ['ball.ply', 'out', '--sigma', '0.001']),
    ('outliers', ['ball.ply', 'out', '--outliers', '2']),
    ('seed', ['ball.ply', 'out', '--seed', '-1']),
    ('cannot read', ['ball.ply', 'out', '--trajectory', 'nothing.txt']),
    ('line 2', ['ball.ply', 'out', '--trajectory', 'bad.txt']),
    ('two poses have the same timestamp', ['ball.ply', 'out', '--trajectory', 'back.txt']),
    ('no poses', ['ball.ply', 'out', '--trajectory', 'empty.txt']),
    ('--trajectory', ['ball.ply', 'out', '--trajectory', 'back.txt', '--views', '3']),
])
def test_a_call_that_cannot_be_used_is_one_line_and_exit_code_2(
    says, arguments, ball, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    ball.export('ball.ply')
    trimesh.PointCloud(ball.vertices).export('points.ply')
    (tmp_path / 'text.ply').write_text('not a mesh')
    (tmp_path / 'bad.txt').write_text('1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n')
    (tmp_path / 'back.txt').write_text('1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n')
    (tmp_path / 'empty.txt').write_text('# nothing\n')
    assert cli.main(
        ['simulate', *arguments, *([] if '--width' in arguments else ['--width', '32'])]) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert any(word in error for word in says.split('|'))
    assert not (tmp_path / 'out').exists()


def test_without_embree_one_sentence_says_what_to_install(ball, monkeypatch):
    monkeypatch.setitem(sys.modules, 'trimesh.ray.ray_pyembree', None)
    with pytest.raises(InputError, match=r'pip install .*gr2t_ros\[simulation\]'):
        RayCaster(ball)


def test_the_tabletop_stands_on_its_table_and_its_cameras_see_it(tmp_path, capsys):
    scene = tabletop()
    assert_allclose(scene.extents[:2], 0.64, atol=1e-6)
    assert scene.bounds[0, 2] < 0 < 0.1 < scene.bounds[1, 2]
    assert scene.is_winding_consistent
    camera = simulated_camera(64, 48)
    for view in rendered_views(scene, camera, tabletop_poses(4)):
        assert view.T_world_camera[2, 3] > 0.15
        assert np.isfinite(view.depth).mean() > 0.3
    assert cli.main([
        'simulate', 'tabletop', str(tmp_path / 'bag'), '--views', '2', '--width', '64',
        '--height', '48']) == 0
    assert len(_read(tmp_path / 'bag')[0]) == 2
