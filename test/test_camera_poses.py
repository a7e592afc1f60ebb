# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The pose of an image's camera, from tf or from a topic."""
from __future__ import annotations

from frames_for_tests import assembler, at, depth, lost, move, MS, S, settled
from messages_for_tests import camera_info, pose_message, tf, transform
import numpy as np
import pytest


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
