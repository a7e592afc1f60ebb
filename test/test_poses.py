# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Interpolated poses and the tree of frames, against scipy, pytransform3d and real recordings."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from gr2t_ros.core.poses import (
    EXTRAPOLATION_NS,
    interpolate,
    inverse,
    MAX_DISORDER_NS,
    MAX_GAP_NS,
    NotYet,
    PoseBuffer,
    TransformError,
    TransformTree,
)
from gr2t_ros.io import messages

MS = 1_000_000
S = 1_000_000_000


def pose(x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    T[:3, 3] = x, y, z
    return T


def random_pose(rng):
    return pose(*rng.normal(size=3), turn=rng.normal(size=3))


def moving(seconds):
    """Return a pose on a smooth path."""
    return pose(seconds, 0.5 * seconds, 0, turn=(0, 0.3 * seconds, 0))


@pytest.mark.parametrize('angle', [0.0, 1e-7, 1e-4, 0.1, 1.0, 3.0, 3.1415])
def test_interpolation_is_linear_and_slerp_as_scipy_has_it(angle):
    rng = np.random.default_rng(1)
    for _ in range(5):
        T_a, axis = random_pose(rng), rng.normal(size=3)
        T_b = T_a @ pose(*rng.normal(size=3), turn=angle * axis / np.linalg.norm(axis))
        slerp = Slerp([0, 1], Rotation.from_matrix([T_a[:3, :3], T_b[:3, :3]]))
        for fraction in (0, 0.3, 1):
            T = interpolate(T_a, T_b, fraction)
            np.testing.assert_allclose(T[:3, :3], slerp(fraction).as_matrix(), atol=1e-7)
            np.testing.assert_allclose(
                T[:3, 3], (1 - fraction) * T_a[:3, 3] + fraction * T_b[:3, 3], atol=1e-12)


def test_inverse():
    T = random_pose(np.random.default_rng(2))
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-12)


class TestPoseBuffer:

    def filled(self, stamps_ns, **options):
        buffer = PoseBuffer('the pose', **options)
        for stamp_ns in stamps_ns:
            buffer.add(stamp_ns, moving(stamp_ns / S))
        return buffer

    def test_between_two_stamps_it_interpolates(self):
        buffer = self.filled([0, 100 * MS])
        np.testing.assert_allclose(buffer.lookup(40 * MS), moving(0.04), atol=1e-9)

    def test_no_extrapolation_but_for_rounded_stamps(self):
        buffer = self.filled([100 * MS, 200 * MS])
        np.testing.assert_array_equal(buffer.lookup(200 * MS + EXTRAPOLATION_NS), moving(0.2))
        np.testing.assert_array_equal(buffer.lookup(100 * MS - EXTRAPOLATION_NS), moving(0.1))
        with pytest.raises(NotYet, match=r'the pose is needed at 0.202 s.*newest.* 0.200 s'):
            buffer.lookup(202 * MS)
        with pytest.raises(TransformError, match=r'needed at 0.098 s.*oldest known is of 0.100 s'):
            buffer.lookup(98 * MS)
        with pytest.raises(NotYet):
            PoseBuffer('the pose').lookup(0)

    def test_order_does_not_matter_and_the_later_of_two_with_one_stamp_counts(self):
        buffer = self.filled([300 * MS, 100 * MS, 0, 200 * MS])
        buffer.add(200 * MS, pose(9))
        np.testing.assert_allclose(buffer.lookup(50 * MS), moving(0.05), atol=1e-9)
        np.testing.assert_array_equal(buffer.lookup(200 * MS), pose(9))

    def test_none_is_invented_in_a_gap_unless_nothing_moved(self):
        buffer = self.filled([0, 2 * MAX_GAP_NS])
        with pytest.raises(TransformError, match=r'between 0.000 s and 2.000 s none') as error:
            buffer.lookup(MAX_GAP_NS)
        assert error.value.reason == 'pose_gap'
        buffer.add(9 * MAX_GAP_NS, moving(2 * MAX_GAP_NS / S))
        np.testing.assert_allclose(buffer.lookup(5 * MAX_GAP_NS), moving(2 * MAX_GAP_NS / S))

    def test_beside_an_unknown_pose_there_is_none(self):
        buffer = self.filled([0, 100 * MS, 300 * MS])
        buffer.add(200 * MS, np.full((4, 4), np.nan))
        buffer.lookup(100 * MS)
        for stamp_ns in (150 * MS, 200 * MS, 250 * MS):
            with pytest.raises(TransformError, match=r'at 0.[12].0 s is no pose') as error:
                buffer.lookup(stamp_ns)
            assert error.value.reason == 'bad_pose'

    def test_the_history_is_bounded_by_time_and_by_count(self):
        buffer = self.filled(range(0, 100 * S, 100 * MS), history=10)
        assert 100 <= len(buffer) < 150
        buffer.lookup(90 * S)
        with pytest.raises(TransformError, match='oldest'):
            buffer.lookup(80 * S)
        assert len(self.filled(range(0, 100 * S, 100 * MS), max_samples=100)) <= 100
        # of a slow publisher there is still something to interpolate
        self.filled(range(0, 100 * S, S), history=0.1).lookup(98 * S + 500 * MS)

    def test_after_a_jump_back_in_time_it_starts_anew(self):
        buffer = self.filled(range(100 * S, 110 * S, 100 * MS))
        for i in range(5):
            buffer.add(i * 100 * MS, pose(7))
        np.testing.assert_array_equal(buffer.lookup(350 * MS), pose(7))
        with pytest.raises(NotYet):
            buffer.lookup(105 * S)

    def test_single_stray_stamps_change_nothing(self):
        buffer = self.filled(range(100 * S, 101 * S, 100 * MS))
        for i in range(20):
            buffer.add(0, pose(7))
            buffer.add(101 * S + i * 100 * MS, moving(101 + 0.1 * i))
        np.testing.assert_allclose(buffer.lookup(100 * S + 50 * MS), moving(100.05), atol=1e-9)

    def test_late_ones_within_the_usual_disorder_are_no_jump(self):
        buffer = self.filled([10 * S])
        for i in range(10):
            buffer.add(10 * S + i * 10 * MS, moving(10 + 0.01 * i))
            stamp_ns = 10 * S + i * 10 * MS - MAX_DISORDER_NS // 2
            buffer.add(stamp_ns, moving(stamp_ns / S))
        assert len(buffer) == 20


class TestTransformTree:

    def test_chains_branches_and_static_ones(self):
        rng = np.random.default_rng(3)
        T = {name: random_pose(rng) for name in 'abcde'}
        tree = TransformTree()
        tree.add('map', 'a', 0, T['a'])
        tree.add('a', 'b', 0, T['b'], static=True)
        tree.add('b', 'c', 0, T['c'])
        tree.add('a', 'd', 0, T['d'])
        tree.add('d', 'e', 0, T['e'], static=True)
        np.testing.assert_allclose(tree.lookup('map', 'c', 0), T['a'] @ T['b'] @ T['c'])
        np.testing.assert_allclose(
            tree.lookup('e', 'c', 0),
            np.linalg.inv(T['d'] @ T['e']) @ T['b'] @ T['c'], atol=1e-12)
        np.testing.assert_allclose(
            tree.lookup('c', 'map', 0), np.linalg.inv(tree.lookup('map', 'c', 0)), atol=1e-12)
        np.testing.assert_array_equal(tree.lookup('c', 'c', 0), np.eye(4))
        assert tree.frames() == ['a', 'b', 'c', 'd', 'e', 'map']
        assert tree.root('c') == 'map' and tree.root('map') == 'map'
        assert tree.moves('e')

    def test_what_two_frames_have_in_common_need_not_be_known(self):
        tree = TransformTree()
        tree.add('map', 'base', 0, pose(1))
        tree.add('base', 'left', 0, pose(2), static=True)
        tree.add('base', 'right', 0, pose(3), static=True)
        np.testing.assert_allclose(tree.lookup('left', 'right', 99 * S), pose(1))

    def test_static_transforms_hold_at_all_times(self):
        tree = TransformTree()
        tree.add('base', 'camera', 5 * S, pose(1), static=True)
        np.testing.assert_array_equal(tree.lookup('base', 'camera', 0), pose(1))
        assert not tree.moves('camera')

    def test_leading_slashes_do_not_matter(self):
        tree = TransformTree()
        tree.add('/map', 'base', 0, pose(1))
        tree.add('base', '/camera', 0, pose(2))
        np.testing.assert_array_equal(tree.lookup('map', '/camera', 0), pose(3))
        assert tree.frames() == ['base', 'camera', 'map']

    def test_a_frame_that_changes_its_parent_follows_the_new_one(self):
        tree = TransformTree()
        tree.add('map', 'cup', 0, pose(1))
        tree.add('map', 'hand', S, pose(5))
        tree.add('hand', 'cup', S, pose(1))
        tree.add('map', 'cup', S - MS, pose(1))  # late, from before
        np.testing.assert_array_equal(tree.lookup('map', 'cup', S), pose(6))
        with pytest.raises(TransformError, match=r'cup to hand \(it led to map until 1.000 s\)'):
            tree.lookup('map', 'cup', S - 100 * MS)

    def test_static_and_dynamic_replace_each_other(self):
        tree = TransformTree()
        tree.add('map', 'camera', 0, pose(1), static=True)
        tree.add('map', 'camera', S, pose(2))
        np.testing.assert_array_equal(tree.lookup('map', 'camera', S), pose(2))
        assert tree.moves('camera')
        tree.add('map', 'camera', 0, pose(3), static=True)
        np.testing.assert_array_equal(tree.lookup('map', 'camera', 9 * S), pose(3))

    def test_loops_and_nameless_frames_are_refused(self):
        tree = TransformTree()
        tree.add('a', 'b', 0, pose(1))
        tree.add('b', 'c', 0, pose(1))
        for static in (False, True):
            with pytest.raises(TransformError, match=r'loop \(a -> c -> b -> a\)'):
                tree.add('c', 'a', 0, pose(1), static)
        with pytest.raises(TransformError, match='loop'):
            tree.add('a', 'a', 0, pose(1))
        with pytest.raises(TransformError, match='need a name'):
            tree.add('/', 'a', 0, pose(1))
        np.testing.assert_array_equal(tree.lookup('a', 'c', 0), pose(2))

    def test_an_unusable_static_transform_is_refused(self):
        with pytest.raises(TransformError, match='not finite'):
            TransformTree().add('a', 'b', 0, np.full((4, 4), np.nan), static=True)

    def test_unconnected_frames_are_named(self):
        tree = TransformTree()
        with pytest.raises(NotYet, match='no tf message'):
            tree.lookup('map', 'camera', 0)
        tree.add('map', 'base', 0, pose(1))
        with pytest.raises(NotYet, match=r'from camera to map at 2.500 s: tf does not know '
                                         'camera, only base, map') as error:
            tree.lookup('map', 'camera', 2500 * MS)
        assert error.value.reason == 'unconnected_frames'
        tree.add('arm', 'camera', 0, pose(1))
        with pytest.raises(NotYet, match='one of arm, camera, the other of base, map'):
            tree.lookup('map', 'camera', 0)

    def test_clear_keeps_what_is_sent_only_once(self):
        tree = TransformTree()
        tree.add('map', 'base', 0, pose(1))
        tree.add('base', 'camera', 0, pose(1), static=True)
        tree.forget(-10 * S)
        assert tree.frames() == ['base', 'camera']

    def test_what_was_looked_up_can_be_changed_without_harm(self):
        tree = TransformTree()
        tree.add('map', 'base', 0, pose(1))
        T = tree.lookup('map', 'base', 0)
        with pytest.raises(ValueError, match='read-only'):
            T[0, 3] = 7


def tf_of(path: Path):
    """Read the transforms of a recording: parent, child, stamp, pose, whether static."""
    with AnyReader([path]) as reader:
        topics = [item for item in reader.connections if item.topic in ('/tf', '/tf_static')]
        for connection, _, data in reader.messages(topics):
            msg = reader.deserialize(data, connection.msgtype)
            for item in messages.transforms(msg):
                yield *item, connection.topic == '/tf_static'


def interpolated(samples, stamp_ns):
    """Interpolate with scipy; None outside the samples."""
    stamps = np.array(sorted(samples))
    if not stamps[0] <= stamp_ns <= stamps[-1]:
        return None
    T = np.eye(4)
    times = (stamps - stamps[0]) / S
    at = (stamp_ns - stamps[0]) / S
    poses = np.array([samples[stamp] for stamp in stamps])
    T[:3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    T[:3, 3] = [np.interp(at, times, poses[:, i, 3]) for i in range(3)]
    return T


@pytest.mark.parametrize(('name', 'camera', 'root'), [
    ('nav2_turtlebot.mcap', 'oakd_rgb_camera_optical_frame', 'map'),
    ('jsk_watercan.bag', 'left_camera_optical_frame', 'map'),
    ('tf_example', 'base_link', 'odom'),
])
def test_recorded_trees_are_as_pytransform3d_has_them(data, name, camera, root):
    transformations = pytest.importorskip('pytransform3d.transform_manager')
    tree = TransformTree(history=1000)
    samples, parents, statics = {}, {}, {}
    for parent, child, stamp_ns, T, static in tf_of(data / 'bags' / name):
        tree.add(parent, child, stamp_ns, T, static)
        parents[child] = parent
        if static:
            statics[child] = T
        else:
            samples.setdefault(child, {})[stamp_ns] = T
    assert tree.root(camera) == root
    assert tree.frames() == sorted(parents.keys() | set(parents.values()))

    stamps = sorted(stamp for item in samples.values() for stamp in item)
    rng = np.random.default_rng(4)
    compared = []
    for stamp_ns in rng.integers(stamps[0], stamps[-1], 5):
        other = transformations.TransformManager(check=False)
        for child, parent in parents.items():
            T = statics.get(child)
            T = interpolated(samples[child], stamp_ns) if T is None else T
            if T is not None:
                other.add_transform(child, parent, T)
        for target, source in [(root, camera), *rng.choice(tree.frames(), (20, 2))]:
            try:
                T = tree.lookup(target, source, int(stamp_ns))
            except (NotYet, TransformError):
                continue
            if target != source:
                np.testing.assert_allclose(T, other.get_transform(source, target), atol=1e-5)
                compared.append(source)
    assert len(compared) > 20 and camera in compared
