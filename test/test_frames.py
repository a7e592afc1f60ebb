# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Images find their camera and their pose, or are counted with a sentence that helps."""
from __future__ import annotations

import struct

import cv2
from messages_for_tests import camera_info, compressed, image, pose_message, tf, transform
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from gr2t_ros.core.poses import inverse
from gr2t_ros.io import frames as frames_module
from gr2t_ros.io import messages
from gr2t_ros.io.frames import FrameAssembler
from gr2t_ros.settings import Settings

MS = 1_000_000
S = 1_000_000_000
DEPTH = np.full((6, 8), 1500, np.uint16)


def at(x, turn=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, turn, 0]).as_matrix()
    T[0, 3] = x
    return T


def assembler(max_waiting=10, rectified=False, info=True, **settings):
    frames = FrameAssembler(
        Settings(**settings), rectified=rectified, max_waiting=max_waiting)
    if info:
        frames.on_camera_info(camera_info())
    return frames


def move(frames, *stamps_ns, parent='map', child='camera', x=1.0, static=False):
    for stamp_ns in stamps_ns:
        frames.world.on_transforms(
            tf(transform(parent, child, stamp_ns, at(x * stamp_ns / S))), static)


def depth(stamp_ns, pixels=DEPTH, **fields):
    return image(pixels, stamp_ns=stamp_ns, **fields)


def settled(frames, seen=0):
    """Return the last views; with those seen before all images must be accounted for."""
    views = frames.ready() + frames.flush()
    assert frames.waiting == 0
    assert frames.read == seen + len(views) + sum(frames.dropped.values())
    return views


def lost(frames, reason, count=1, seen=0):
    """Expect images to be dropped for one reason, and return its sentence."""
    settled(frames, seen)
    assert dict(frames.dropped) == {reason: count}
    return frames.explanations[reason]


class TestPoseFromTf:

    def test_an_image_waits_until_tf_has_passed_its_stamp(self):
        frames = assembler()
        move(frames, 0)
        frames.on_depth(depth(50 * MS))
        assert frames.ready() == [] and frames.waiting == 1
        move(frames, 100 * MS)
        view, = frames.ready()
        np.testing.assert_allclose(view.T_world_camera, at(0.05), atol=1e-9)
        assert view.stamp_ns == 50 * MS and frames.world.frame == 'map'
        assert (view.camera.width, view.camera.height) == (8, 6)
        np.testing.assert_allclose(view.depth, 1.5)
        assert frames.ready() == [] and not frames.dropped

    def test_an_offset_above_0_is_for_images_that_are_stamped_early(self):
        frames = assembler(time_offset=0.03)
        move(frames, 0, 100 * MS)
        frames.on_depth(depth(50 * MS))
        view, = frames.ready()
        np.testing.assert_allclose(view.T_world_camera, at(0.08), atol=1e-9)
        assert view.stamp_ns == 80 * MS

    def test_views_come_in_the_order_of_the_images(self):
        frames = assembler()
        for i in range(5):
            frames.on_depth(depth(i * 10 * MS))
        move(frames, 0, 25 * MS)
        assert [view.stamp_ns for view in frames.ready()] == [0, 10 * MS, 20 * MS]
        move(frames, 50 * MS)
        assert [view.stamp_ns for view in frames.ready()] == [30 * MS, 40 * MS]

    def test_one_image_with_a_stamp_in_the_future_does_not_hold_up_the_others(self):
        frames = assembler()
        move(frames, 0, 100 * MS)
        for stamp_ns in (99 * S, 10 * MS, 20 * MS):
            frames.on_depth(depth(stamp_ns))
        assert [view.stamp_ns for view in frames.ready()] == [10 * MS, 20 * MS]

    def test_the_world_is_the_root_above_the_camera(self):
        frames = assembler()
        move(frames, 0, 100 * MS, parent='odom', child='base')
        move(frames, 0, parent='/base', child='/camera', static=True)
        frames.world.on_transforms(tf(transform('map', 'odom', 0, at(5))), True)
        frames.on_depth(depth(50 * MS, frame='/camera'))
        frames.on_camera_info(camera_info(frame='/camera'))
        view, = frames.ready()
        np.testing.assert_allclose(view.T_world_camera, at(5.05), atol=1e-9)
        assert frames.world.frame == 'map'

    def test_a_given_world_frame_is_kept(self):
        frames = assembler(world_frame='/odom')
        move(frames, 0, 100 * MS, parent='map', child='odom', x=7)
        move(frames, 0, 100 * MS, parent='odom', child='camera')
        frames.on_depth(depth(50 * MS))
        np.testing.assert_allclose(frames.ready()[0].T_world_camera, at(0.05), atol=1e-9)
        assert frames.world.frame == 'odom'

    def test_a_tree_of_static_transforms_alone_is_no_world(self):
        frames = assembler()
        move(frames, 0, parent='base', child='camera', static=True)
        frames.on_depth(depth(0))
        assert frames.ready() == []
        assert 'up to base are all static' in lost(frames, 'unconnected_frames')
        frames = assembler(world_frame='base')
        move(frames, 0, parent='base', child='camera', static=True)
        frames.on_depth(depth(0))
        assert len(frames.ready()) == 1

    def test_without_tf(self):
        frames = assembler()
        frames.on_depth(depth(12_300 * MS))
        assert 'camera frame camera at 12.300 s: tf knows no frame yet' in lost(
            frames, 'unconnected_frames')

    def test_of_another_camera(self):
        frames = assembler()
        move(frames, 0, S, child='head')
        frames.on_depth(depth(0))
        assert 'tf knows head, map' in lost(frames, 'unconnected_frames')

    def test_with_a_world_frame_that_tf_does_not_have(self):
        frames = assembler(world_frame='mpa')
        move(frames, 0, S)
        frames.on_depth(depth(0))
        assert lost(frames, 'unconnected_frames').startswith(
            'no transform from camera to mpa at 0.000 s: tf does not know mpa, only camera, map; '
            'publish it or set world_frame')

    def test_in_two_parts(self):
        frames = assembler(world_frame='map')
        move(frames, 0, S, parent='map', child='base')
        move(frames, 0, S, parent='arm', child='camera')
        frames.on_depth(depth(0))
        assert 'one of arm, camera, the other of base, map' in lost(frames, 'unconnected_frames')

    def test_after_its_end(self):
        frames = assembler()
        move(frames, 0, 100 * MS)
        frames.on_depth(depth(500 * MS))
        sentence = lost(frames, 'no_pose')
        assert 'needed at 0.500 s, but the newest received is of 0.100 s' in sentence
        assert sentence.endswith('(given up at the end)')

    def test_before_its_begin(self):
        frames = assembler()
        move(frames, 10 * S, 11 * S)
        frames.on_depth(depth(5 * S))
        assert frames.ready() == [] and frames.waiting == 0
        assert 'oldest known is of 10.000 s' in lost(frames, 'pose_too_old')

    def test_poses_of_nan_cost_the_images_at_that_time(self):
        frames = assembler()
        bad = transform('map', 'camera', 50 * MS, at(1))
        bad.transform.translation.x = np.nan
        move(frames, 0, 20 * MS)
        frames.world.on_transforms(tf(bad), False)
        move(frames, 80 * MS, 100 * MS)
        for stamp_ns in (10 * MS, 30 * MS, 50 * MS, 70 * MS, 90 * MS):
            frames.on_depth(depth(stamp_ns))
        assert [view.stamp_ns for view in frames.ready()] == [10 * MS, 90 * MS]
        assert 'not finite' in lost(frames, 'bad_pose', 3, seen=2)

    def test_a_loop_is_left_out_and_said(self):
        frames = assembler()
        move(frames, 0, S)
        move(frames, 0, S, parent='camera', child='map')
        frames.on_depth(depth(0))
        assert len(settled(frames)) == 1
        assert 'camera -> map' in frames.world.explanations['transform_loop']

    def test_after_a_jump_back_in_time_it_goes_on(self):
        frames = assembler()
        move(frames, *range(100 * S, 101 * S, 100 * MS))
        frames.on_depth(depth(100 * S))
        assert len(frames.ready()) == 1
        for stamp_ns in range(0, S, 100 * MS):
            move(frames, stamp_ns)
            frames.on_depth(depth(stamp_ns))
        views = settled(frames, seen=1)
        assert len(views) >= 8
        np.testing.assert_allclose(views[-1].T_world_camera, at(0.9), atol=1e-9)


    def corrected(self, steps, **settings):
        """Return frames that got map -> odom with these steps, and an odom that moves."""
        frames = assembler(world_frame='map', **settings)
        x = 0.0
        for i, step in enumerate(steps):
            x += step
            frames.world.on_transforms(tf(
                transform('map', 'odom', i * 50 * MS, at(x)),
                transform('odom', 'camera', i * 50 * MS, at(0.1 * i))), False)
            frames.on_depth(depth(i * 50 * MS))
            frames.ready()
        return frames

    def test_a_world_that_jumps_is_noticed(self):
        frames = self.corrected([0, 0, 0, 0, 0.12, 0, 0, 0])
        assert frames.world.explanations['world_jump'].startswith(
            'frame odom jumped by 0.12 m and 0.0 degrees in map about 0.250 s')
        assert 'set world_frame to odom' in frames.world.explanations['world_jump']

    @pytest.mark.parametrize('steps', [
        [0, 0, 0, 0.02, 0, 0, 0.02, 0, 0],
        [0, 0.05, 0.1, 0.15, 0.2, 0.15, 0.1, 0.05, 0], [0.2] * 9])
    def test_small_corrections_and_fast_robots_are_no_jumps(self, steps):
        assert not self.corrected(steps).world.explanations


class TestWaiting:

    def test_too_many_drop_the_oldest(self):
        frames = assembler(max_waiting=3)
        for i in range(5):
            frames.on_depth(depth(i * 10 * MS))
        assert frames.waiting == 3 and frames.dropped == {'unconnected_frames': 2}
        assert 'given up with 3 later images waiting' in frames.explanations['unconnected_frames']
        move(frames, 0, 100 * MS)
        assert [view.stamp_ns for view in frames.ready()] == [20 * MS, 30 * MS, 40 * MS]

    def test_those_that_have_their_pose_are_not_among_them(self):
        frames = assembler(max_waiting=2)
        move(frames, 0, 100 * MS)
        for i in range(5):
            frames.on_depth(depth(i * 10 * MS))
        assert len(frames.ready()) == 5

    def test_too_long_drops_live_images(self):
        frames = assembler(max_wait_for_pose=1.0)
        frames.on_depth(depth(0), received_ns=50 * S)
        frames.on_depth(depth(10 * MS), received_ns=50 * S + 900 * MS)
        assert frames.ready(now_ns=51 * S) == [] and frames.waiting == 2
        assert frames.ready(now_ns=51 * S + MS) == [] and frames.waiting == 1
        frames.on_depth(depth(20 * MS), received_ns=52 * S)
        frames.ready()
        assert frames.waiting == 1 and frames.dropped == {'unconnected_frames': 2}
        assert 'given up after max_wait_for_pose (1 s)' in \
            frames.explanations['unconnected_frames']

    def test_images_of_a_recording_wait_for_late_tf(self):
        frames = assembler(max_waiting=1000, max_wait_for_pose=0.1)
        for i in range(200):
            frames.on_depth(depth(i * 33 * MS))
            assert frames.ready() == []
        move(frames, *range(0, 7 * S, 10 * MS))
        assert len(frames.ready()) == 200


SOURCES = ('pose', 'pose_with_covariance', 'odometry', 'transform')


class TestPoseFromMessages:

    def filled(self, source, child='', parent='map', **settings):
        frames = assembler(pose_source=source, **settings)
        for stamp_ns in (0, 100 * MS):
            frames.on_pose(pose_message(source, stamp_ns, at(stamp_ns / S), parent, child))
        return frames

    @pytest.mark.parametrize('source', SOURCES)
    @pytest.mark.parametrize('child', ['', '/camera'])
    def test_each_kind_is_the_pose_of_the_camera(self, source, child):
        frames = self.filled(source, child)
        for stamp_ns in (50 * MS, 150 * MS):
            frames.on_depth(depth(stamp_ns))
        view, = frames.ready()
        np.testing.assert_allclose(view.T_world_camera, at(0.05), atol=1e-9)
        assert frames.world.frame == 'map' and frames.waiting == 1
        assert f'the {source} message is needed at 0.150 s' in lost(
            frames, 'no_pose', seen=1)

    @pytest.mark.parametrize('source', ['odometry', 'transform'])
    def test_of_another_frame_tf_leads_on_to_the_camera(self, source):
        frames = self.filled(source, 'base')
        frames.on_depth(depth(50 * MS))
        assert frames.ready() == []
        T_base_camera = at(3, turn=0.5)
        frames.world.on_transforms(tf(transform('base', 'mount', 0, at(2)),
                                transform('mount', 'camera', 0, at(-2) @ T_base_camera)), True)
        view, = frames.ready()
        np.testing.assert_allclose(view.T_world_camera, at(0.05) @ T_base_camera, atol=1e-9)

    @pytest.mark.parametrize('source', SOURCES)
    def test_poses_that_jump_are_noticed(self, source):
        frames = assembler(pose_source=source)
        for i in range(8):
            x = 0.01 * i + (0.5 if i > 3 else 0.0)
            frames.on_pose(pose_message(source, i * 50 * MS, at(x), 'map', ''))
            frames.on_depth(depth(i * 50 * MS))
        assert len(frames.ready()) == 8
        assert frames.world.explanations['world_jump'].startswith(
            f'the pose of the camera in the {source} messages jumped by 0.51 m and 0.0 degrees in '
            'map about')

    def test_of_another_frame_without_tf_is_said(self):
        frames = self.filled('odometry', 'base')
        frames.on_depth(depth(50 * MS))
        sentence = lost(frames, 'unconnected_frames')
        assert 'no transform from camera to base' in sentence
        assert 'the odometry messages are of base' in sentence

    def test_tf_leads_from_the_messages_frame_to_a_given_world(self):
        frames = self.filled('odometry', 'camera', parent='odom', world_frame='map')
        frames.world.on_transforms(tf(transform('map', 'odom', 0, at(5))), True)
        frames.on_depth(depth(50 * MS))
        np.testing.assert_allclose(frames.ready()[0].T_world_camera, at(5.05), atol=1e-9)
        assert frames.world.frame == 'map'

    def test_without_any_name_of_the_world(self):
        frames = self.filled('pose', parent='')
        frames.on_depth(depth(0))
        assert 'set world_frame' in lost(frames, 'no_world_frame')
        frames = self.filled('pose', parent='', world_frame='room')
        frames.on_depth(depth(0))
        assert len(frames.ready()) == 1

    def test_without_messages(self):
        frames = assembler(pose_source='pose')
        frames.on_depth(depth(0))
        assert 'the pose message has not been received' in lost(frames, 'no_pose')

    @pytest.mark.parametrize('source', SOURCES)
    def test_unusable_poses_cost_the_images_at_that_time(self, source):
        frames = self.filled(source)
        bad = pose_message(source, 200 * MS, at(1))
        part = bad
        while not hasattr(part, 'orientation') and source != 'transform':
            part = part.pose
        rotation = part.transform.rotation if source == 'transform' else part.orientation
        rotation.w = 0.0
        frames.on_pose(bad)
        frames.on_depth(depth(150 * MS))
        assert 'quaternion of length 0' in lost(frames, 'bad_pose')


class TestCameraInfo:

    def pair(self, **options):
        frames = assembler(info=False, **options)
        move(frames, *range(0, 10 * S, 100 * MS))
        return frames

    def test_an_image_waits_for_it(self):
        frames = self.pair()
        frames.on_depth(depth(0))
        assert frames.ready() == []
        frames.on_camera_info(camera_info(stamp_ns=S))
        assert len(frames.ready()) == 1

    def test_stamps_need_not_be_equal_and_the_object_stays_the_same(self):
        frames = self.pair()
        for i in range(3):
            frames.on_camera_info(camera_info(stamp_ns=i * S))
            frames.on_depth(depth(i * S + 300 * MS))
        first, *others = frames.ready()
        assert all(view.camera is first.camera for view in others) and len(others) == 2

    def test_a_change_of_intrinsics_is_taken_from_its_stamp_on(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(stamp_ns=S))
        frames.on_depth(depth(1900 * MS))
        frames.on_depth(depth(2 * S))
        frames.on_camera_info(camera_info(stamp_ns=2 * S, focal=20.0))
        frames.on_depth(depth(2100 * MS))
        assert [view.camera.fx for view in frames.ready()] == [10, 20, 20]
        frames.on_camera_info(camera_info(16, 12, stamp_ns=3 * S, focal=30.0))
        frames.on_depth(depth(3 * S, np.full((12, 16), 1500, np.uint16)))
        assert frames.ready()[0].camera.fx == 30

    def test_of_another_size(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(16, 12))
        frames.on_depth(depth(0))
        assert lost(frames, 'image_size').startswith(
            'depth image is 8x6 pixels, but its camera_info is for 16x12')

    def test_of_another_frame(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(frame='colour'))
        frames.on_depth(depth(0))
        assert 'images are of frame camera, but camera_info only of colour' in lost(
            frames, 'no_camera_info')

    def test_none_at_all(self):
        frames = self.pair()
        frames.on_depth(depth(0))
        assert 'no camera_info has been received' in lost(frames, 'no_camera_info')

    def test_nameless_frames_go_with_any(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(frame=''))
        frames.on_depth(depth(0))
        assert len(frames.ready()) == 1
        frames = self.pair()
        frames.on_camera_info(camera_info())
        frames.on_depth(depth(0, frame=''))
        assert len(frames.ready()) == 1
        frames = self.pair()
        frames.on_camera_info(camera_info(frame=''))
        frames.on_depth(depth(0, frame=''))
        assert 'frame_id' in lost(frames, 'no_frame_id')

    def test_uncalibrated_until_it_is(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(focal=0.0))
        frames.on_depth(depth(0))
        assert 'not calibrated' in lost(frames, 'uncalibrated')
        frames.on_camera_info(camera_info())
        frames.on_depth(depth(0))
        assert len(frames.ready()) == 1

    def test_a_rectified_image_has_the_rectified_camera(self):
        frames = self.pair(rectified=True)
        info = camera_info(focal=20.0)
        info.k = camera_info(focal=10.0).k
        frames.on_camera_info(info)
        frames.on_depth(depth(0))
        assert frames.ready()[0].camera.fx == 20


class TestDepth:

    def one(self, pixels, **fields):
        frames = assembler()
        move(frames, 0)
        frames.on_depth(depth(0, np.asarray(pixels), **fields))
        return frames

    def test_depths_out_of_range_are_invalid(self):
        pixels = np.full((6, 8), 1000, np.uint16)
        pixels[0, :4] = 99, 100, 5000, 5001
        view, = self.one(pixels).ready()
        np.testing.assert_array_equal(
            view.depth[0, :4], np.array([np.nan, 0.1, 5, np.nan], np.float32))

    def test_without_any_valid_pixel(self):
        sentence = lost(self.one(np.zeros((6, 8), np.uint16)), 'no_valid_depth')
        assert sentence == 'depth image has no valid pixel'
        sentence = lost(self.one(np.full((6, 8), 7000, np.uint16)), 'no_valid_depth')
        assert 'depth_max 5 m; their median is 7 m' in sentence

    @pytest.mark.parametrize(('pixels', 'encoding'), [
        (np.full((6, 8), 1234, np.float32), '32FC1'), (np.full((6, 8), 2, np.uint16), '16UC1')])
    def test_a_unit_taken_wrongly_is_said(self, pixels, encoding):
        frames = self.one(pixels, encoding=encoding)
        assert '32FC1 in metres' in lost(frames, 'depth_unit')

    def test_unusable_messages_are_counted_and_the_rest_goes_on(self):
        frames = self.one(DEPTH, encoding='rgb8')
        frames.on_depth(depth(0, step=3))
        frames.on_depth(compressed('jpeg', b''))
        frames.on_depth(depth(0))
        assert len(settled(frames)) == 1
        assert frames.dropped == {'encoding': 2, 'image_size': 1}
        assert "'rgb8'" in frames.explanations['encoding']

    def test_an_image_that_comes_twice_is_used_once(self):
        frames = self.one(DEPTH)
        move(frames, 100 * MS)
        for stamp_ns in (50 * MS, 40 * MS, 50 * MS, 40 * MS):
            frames.on_depth(depth(stamp_ns))
        assert [view.stamp_ns for view in frames.ready()] == [0, 50 * MS, 40 * MS]
        assert frames.dropped == {'duplicate': 2}
        assert 'came a second time' in frames.explanations['duplicate']

    def test_a_loop_is_no_duplicate(self):
        frames = assembler()
        move(frames, 0, 500 * MS)
        for stamp_ns in (0, 200 * MS, 400 * MS, 0, 200 * MS, 400 * MS):
            frames.on_depth(depth(stamp_ns))
        assert len(settled(frames)) == 6

    @pytest.mark.parametrize('stamp_ns', [-1, -(1 << 31) * S, (1 << 31) * S])
    def test_stamps_that_no_clock_has(self, stamp_ns):
        frames = assembler()
        move(frames, 0)
        frames.on_depth(depth(stamp_ns))
        assert 'writes wrong headers' in lost(frames, 'bad_stamp')

    def test_large_images_of_another_size_are_not_even_decoded(self, monkeypatch):
        monkeypatch.setattr(messages, 'depth', None)
        frames = assembler()
        frames.on_depth(depth(0, height=5000, width=5000, step=10000))
        header = struct.pack('>8s I4s IIBBBBB', b'\x89PNG\r\n\x1a\n', 13, b'IHDR', 5000, 5000,
                             16, 0, 0, 0, 0)
        frames.on_depth(compressed('16UC1; compressedDepth png', bytes(12) + header))
        frames.on_depth(compressed(
            '16UC1; compressedDepth rvl', bytes(12) + struct.pack('<II', 5000, 5000)))
        assert '5000x5000 pixels, but its camera_info is for 8x6' in lost(
            frames, 'image_size', 3)

    def test_of_huge_images_fewer_wait(self, monkeypatch):
        monkeypatch.setattr(frames_module, '_MAX_BYTES', 3 * DEPTH.size * 4)
        frames = assembler(max_waiting=10)
        for i in range(5):
            frames.on_depth(depth(i * 10 * MS))
        assert frames.waiting == 3

    def test_compressed_images(self):
        frames = assembler()
        move(frames, 0)
        png = bytes(12) + cv2.imencode('.png', DEPTH)[1].tobytes()
        frames.on_depth(compressed('16UC1; compressedDepth png', png))
        np.testing.assert_allclose(frames.ready()[0].depth, 1.5)


def test_a_recording_gives_the_depths_and_poses_that_it_was_made_of(data):
    frames = assembler(max_waiting=100, rectified=True, info=False)
    views = []
    with AnyReader([data / 'bags' / 'kitchen_sweep']) as reader:
        for connection, _, raw in reader.messages():
            msg = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype.endswith('Image'):
                frames.on_depth(msg)
            elif connection.msgtype.endswith('CameraInfo'):
                frames.on_camera_info(msg)
            else:
                frames.world.on_transforms(msg, connection.topic == '/tf_static')
            views += frames.ready()
            if len(views) == 10:
                break
    assert frames.world.frame == 'map' and not frames.dropped
    assert not frames.explanations and not frames.world.explanations
    original = data / 'real_rgbd' / 'redkitchen'
    for i, view in enumerate(views):
        name = f'frame-{10 * i:06}'
        pixels = cv2.imread(str(original / f'{name}.depth.png'), cv2.IMREAD_UNCHANGED)
        metres = pixels / 1000
        valid = (pixels < 65535) & (metres >= 0.1) & (metres <= 5)
        np.testing.assert_array_equal(np.isfinite(view.depth), valid)
        np.testing.assert_allclose(view.depth[valid], metres[valid], rtol=1e-6)
        # its rotations are of length 1 to four digits
        T_world_camera = np.loadtxt(original / f'{name}.pose.txt')
        np.testing.assert_allclose(view.T_world_camera, T_world_camera, atol=1e-4)
        assert view.camera.fx == 585


def test_rclpy_messages_do():
    """The same code serves the live node."""
    sensor = pytest.importorskip('sensor_msgs.msg')
    geometry = pytest.importorskip('geometry_msgs.msg')
    frames = FrameAssembler(Settings(pose_source='pose'), rectified=False)
    info = sensor.CameraInfo(
        width=8, height=6, distortion_model='plumb_bob', k=[9.0, 0, 4, 0, 9, 3, 0, 0, 1])
    info.header.frame_id = 'camera'
    frames.on_camera_info(info)
    at_pose = geometry.PoseStamped()
    at_pose.header.frame_id = 'map'
    at_pose.pose.position.x = 2.0
    frames.on_pose(at_pose)
    msg = sensor.Image(width=8, height=6, encoding='16UC1', step=16)
    msg.header.frame_id = 'camera'
    msg.data = DEPTH.tobytes()
    frames.on_depth(msg, received_ns=0)
    view, = frames.ready(now_ns=1)
    np.testing.assert_array_equal(inverse(view.T_world_camera), at(-2))
    assert view.camera.fx == 9
