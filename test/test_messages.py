# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every encoding of depth, every kind of pose, and messages whose numbers lie."""
from __future__ import annotations

from array import array
from contextlib import contextmanager, suppress
import struct

import cv2
from hypothesis import given, settings, strategies
from messages_for_tests import camera_info, compressed, image, make, pose_message, tf, transform
import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores
from scipy.spatial.transform import Rotation

from gr2t_ros.errors import FrameError
from gr2t_ros.io import messages

MILLIMETRES = np.array([[0, 1, 1000], [1234, 65534, 65535]], np.uint16)
METRES = np.array([[np.nan, 0.001, 1], [1.234, 65.534, np.nan]], np.float32)


@contextmanager
def refused(reason, match):
    with pytest.raises(FrameError, match=match) as error:
        yield
    assert error.value.reason == reason


class TestDepthImage:

    @pytest.mark.parametrize('encoding', ['16UC1', 'mono16'])
    def test_whole_numbers_are_millimetres(self, encoding):
        depth = messages.depth_image(image(MILLIMETRES, encoding))
        assert depth.dtype == np.float32 and depth.flags.c_contiguous
        np.testing.assert_array_equal(depth, METRES)

    def test_floats_are_metres(self):
        raw = np.array([[np.nan, np.inf, -np.inf], [0, -1, 1.5]], np.float32)
        depth = messages.depth_image(image(raw, '32FC1'))
        np.testing.assert_array_equal(depth, [[np.nan] * 3, [np.nan, np.nan, 1.5]])
        assert np.isinf(raw[0, 1])  # the message is as it was

    @pytest.mark.parametrize(('encoding', 'raw'), [('16UC1', MILLIMETRES), ('32FC1', METRES)])
    @pytest.mark.parametrize('big', [0, 1])
    @pytest.mark.parametrize('padding', [0, 1, 64])
    def test_any_step_and_either_endianness(self, encoding, raw, big, padding):
        swapped = np.ascontiguousarray(raw.astype(raw.dtype.newbyteorder('>' if big else '<')))
        rows = swapped.view(np.uint8).reshape(2, -1)
        data = np.hstack([rows, np.full((2, padding), 77, np.uint8)]).ravel()
        step = rows.shape[1] + padding
        for kept in (len(data), len(data) - padding):  # some drivers do not pad the last row
            msg = image(raw, encoding, is_bigendian=big, step=step, data=data[:kept])
            np.testing.assert_array_equal(messages.depth_image(msg), METRES)

    def test_the_data_of_rclpy_and_of_rosbags_do(self):
        msg = image(MILLIMETRES)
        for data in (array('B', MILLIMETRES.tobytes()), MILLIMETRES.tobytes()):
            msg.data = data
            np.testing.assert_array_equal(messages.depth_image(msg), METRES)
        msg.data = np.frombuffer(MILLIMETRES.tobytes(), np.uint8)
        assert not msg.data.flags.writeable
        np.testing.assert_array_equal(messages.depth_image(msg), METRES)

    def test_rclpy_messages_do(self):
        types = pytest.importorskip('sensor_msgs.msg')
        msg = types.Image(height=2, width=3, encoding='16UC1', step=6)
        msg.data = array('B', MILLIMETRES.tobytes())
        np.testing.assert_array_equal(messages.depth(msg), METRES)
        info = types.CameraInfo(height=2, width=3, k=[9.0, 0, 1, 0, 8, 1, 0, 0, 1])
        assert messages.camera(info, rectified=False).fy == 8
        msg = types.CompressedImage(format='16UC1; compressedDepth png')
        msg.data = array('B', png_of(MILLIMETRES))
        np.testing.assert_array_equal(messages.depth(msg), METRES)

    def test_other_encodings_are_refused_with_those_known(self):
        for encoding in ('rgb8', '64FC1', '', 'x' * 10_000):
            with refused('encoding', f'{encoding[:20]}.*16UC1 and mono16.*32FC1'):
                messages.depth_image(image(MILLIMETRES, encoding))

    @pytest.mark.parametrize(('fields', 'match'), [
        ({'step': 5}, '3x2 16UC1 has step 5, but a row takes 6'),
        ({'step': 0}, 'step 0'),
        ({'step': 7}, 'step 7 has 12 bytes of data where it needs 13'),
        ({'height': 3}, '3x3 16UC1 with step 6 has 12 bytes of data where it needs 18'),
        ({'data': np.zeros(0, np.uint8)}, 'has 0 bytes'),
        ({'height': 0}, '3x0 pixels'),
        ({'width': 0}, '0x2 pixels'),
        ({'height': 2**32 - 1, 'width': 2**32 - 1}, '4294967295x4294967295 pixels'),
        ({'height': 2**32 - 1, 'width': 1}, '1x4294967295 pixels'),
    ])
    def test_sizes_that_do_not_fit_each_other_are_refused(self, fields, match):
        with refused('image_size', match):
            messages.depth_image(image(MILLIMETRES, **fields))


CONFIG = struct.pack('<iff', 0, 0, 0)


def png_of(pixels, config=CONFIG):
    return config + cv2.imencode('.png', pixels)[1].tobytes()


def rvl_of(pixels, config=CONFIG):
    """Encode as compressed_depth_image_transport does, number by number."""
    nibbles = []

    def put(value):
        while True:
            value, low = value >> 3, value & 7
            nibbles.append(low | (8 if value else 0))
            if not value:
                return

    flat = [int(value) for value in pixels.ravel()]
    at = previous = 0
    while at < len(flat):
        for is_run in (lambda value: value == 0, lambda value: value != 0):
            end = at
            while end < len(flat) and is_run(flat[end]):
                end += 1
            put(end - at)
            for value in flat[at:end] if flat[at:end] and flat[at] else []:
                delta = value - previous
                put(2 * delta if delta >= 0 else -2 * delta - 1)
                previous = value
            at = end
    nibbles += [0] * (-len(nibbles) % 8)
    words = b''.join(
        struct.pack('<I', int(''.join(f'{nibble:x}' for nibble in nibbles[i:i + 8]), 16))
        for i in range(0, len(nibbles), 8))
    return config + struct.pack('<II', pixels.shape[1], pixels.shape[0]) + words


class TestCompressedDepth:

    @pytest.mark.parametrize(('fmt', 'encode'), [
        ('16UC1; compressedDepth', png_of),
        ('16UC1; compressedDepth png', png_of),
        ('mono16; compressedDepth png', png_of),
        ('16UC1', png_of),
        ('16UC1; compressedDepth rvl', rvl_of),
    ])
    def test_millimetres(self, fmt, encode):
        rng = np.random.default_rng(1)
        raw = np.where(rng.random((30, 41)) < 0.7, rng.integers(0, 65536, (30, 41)), 0)
        raw = raw.astype(np.uint16)
        depth = messages.depth(compressed(fmt, encode(raw)))
        np.testing.assert_array_equal(depth, messages.depth_image(image(raw)))

    @pytest.mark.parametrize(('fmt', 'encode'), [
        ('32FC1; compressedDepth', png_of),
        ('32FC1; compressedDepth png', png_of),
        ('32FC1; compressedDepth rvl', rvl_of),
    ])
    def test_metres_are_sent_as_quantised_inverse_depth(self, fmt, encode):
        depth = np.random.default_rng(2).uniform(0.5, 9, (20, 30)).astype(np.float32)
        depth[3:5] = np.nan
        quantisation, depth_max = 100.0, 10.0
        a = quantisation * (quantisation + 1)
        b = 1 - a / depth_max
        with np.errstate(invalid='ignore'):
            inverse = np.where(depth < depth_max, a / depth + b, 0).astype(np.uint16)
        read = messages.compressed_depth(
            compressed(fmt, encode(inverse, struct.pack('<iff', 0, a, b))))
        np.testing.assert_array_equal(np.isnan(read), np.isnan(depth))
        # a step of the quantisation is depth^2 / a
        assert np.nanmax(np.abs(read - depth) / depth**2) < 1.01 / a

    def test_rvl_by_hand(self):
        # 2 zeros, 2 others: +5 (zigzag 10 = 12 octal, low digit first, a2 1) and +1, 1 zero, 0
        data = CONFIG + struct.pack('<II', 5, 1) + struct.pack('<I', 0x22a12100)
        depth = messages.compressed_depth(compressed('16UC1; compressedDepth rvl', data))
        np.testing.assert_array_equal(
            depth, np.array([[np.nan, np.nan, 0.005, 0.006, np.nan]], np.float32))

    def test_other_formats_are_refused_with_those_known(self):
        for fmt in ('16UC1; png compressed ', '16UC1; compressedDepth jpeg'):
            with refused('encoding', f'{fmt}.*known are.*png.*rvl'):
                messages.compressed_depth(compressed(fmt, png_of(MILLIMETRES)))
        for fmt in ('', 'jpeg', 'bgr8; compressedDepth png'):
            with refused('encoding', 'known are'):
                messages.compressed_depth(compressed(fmt, png_of(MILLIMETRES)))

    def test_damaged_data_are_refused(self):
        raw = np.random.default_rng(3).integers(0, 4000, (40, 50)).astype(np.uint16)
        png, rvl = png_of(raw), rvl_of(raw)
        for fmt, data, match in [
            ('png', b'', '0 bytes'), ('png', CONFIG, 'no PNG'), ('png', png[:60], 'cut off'),
            ('png', png[:-12], 'cut off'),
            ('png', png[:12 + 8] + png[12 + 33:], 'no header'),
            ('png', png[:200] + bytes(100) + png[300:], 'cannot be decoded'),
            ('png', png_of(raw.astype(np.uint8)), '8 bits'),
            ('png', png_of(np.dstack([raw] * 3)), 'colour type 2'),
            ('rvl', CONFIG + b'1234', '4 bytes of RVL'), ('rvl', rvl[:-8], 'not make 50x40'),
            ('rvl', CONFIG + struct.pack('<IIII', 5, 5, 0, 0), 'not make 5x5'),
        ]:
            with refused('damaged_image', match):
                messages.compressed_depth(compressed(f'16UC1; compressedDepth {fmt}', data))

    def test_huge_sizes_are_refused_before_they_cost_memory(self):
        png = bytearray(png_of(MILLIMETRES))
        png[12 + 16:12 + 24] = struct.pack('>II', 60_000, 60_000)
        rvl = CONFIG + struct.pack('<II', 2**31, 2**31) + b'\0' * 8
        for fmt, data in (('png', bytes(png)), ('rvl', rvl)):
            with refused('image_size', 'pixels; from 1 to'):
                messages.compressed_depth(compressed(f'16UC1; compressedDepth {fmt}', data))
        # OpenCV 5.0 takes 4 GB and 14 s where a chunk's length says so
        png = bytearray(png_of(MILLIMETRES))
        png[12 + 33] = 255
        with refused('damaged_image', 'cut off'):
            messages.compressed_depth(compressed('16UC1; compressedDepth png', bytes(png)))

    @settings(max_examples=300, deadline=None, derandomize=True, database=None)
    @given(strategies.binary(max_size=80), strategies.integers(0, 9), strategies.integers(0, 9),
           strategies.sampled_from(['16UC1', '32FC1']))
    def test_rubbish_as_rvl_gives_an_image_of_its_size_or_a_frame_error(
            self, rubbish, width, height, encoding):
        data = CONFIG + struct.pack('<II', width, height) + rubbish
        try:
            depth = messages.compressed_depth(
                compressed(f'{encoding}; compressedDepth rvl', data))
        except FrameError:
            return
        assert depth.shape == (height, width)

    @settings(max_examples=200, deadline=None, derandomize=True, database=None)
    @given(strategies.integers(0, 10_000), strategies.integers(0, 255))
    def test_a_png_with_a_wrong_byte_gives_an_image_or_a_frame_error(self, place, value):
        data = bytearray(png_of(np.arange(300, dtype=np.uint16).reshape(15, 20) * 7))
        data[place % len(data)] = value
        with suppress(FrameError):
            messages.compressed_depth(compressed('16UC1; compressedDepth png', bytes(data)))


class TestCamera:

    def test_a_raw_image_has_K_and_D_and_a_rectified_one_P(self):
        info = camera_info(width=8, height=6, focal=10.0, d=np.array([0.1, 0, 0, 0, 0]),
                           p=np.array([9.0, 0, 4, 0, 0, 9.5, 3, 0, 0, 0, 1, 0]))
        raw = messages.camera(info, rectified=False)
        assert (raw.fx, raw.distortion[0], raw.width, raw.height) == (10, 0.1, 8, 6)
        rectified = messages.camera(info, rectified=True)
        assert (rectified.fx, rectified.fy, rectified.distortion) == (9, 9.5, ())

    def test_ros_1_writes_capitals(self):
        ros1 = get_typestore(Stores.ROS1_NOETIC).types['sensor_msgs/msg/CameraInfo']
        info = camera_info()
        fields = {name: getattr(info, name.lower()) for name in ros1.__dataclass_fields__
                  if name != '__msgtype__'}
        assert messages.camera(ros1(**fields), rectified=False) == messages.camera(
            info, rectified=False)

    def test_region_and_binning(self):
        roi = make('RegionOfInterest', x_offset=2, y_offset=1, width=4, height=4, do_rectify=False)
        camera = messages.camera(camera_info(roi=roi, binning_x=2, binning_y=2), rectified=False)
        assert (camera.width, camera.height, camera.fx) == (2, 2, 5)
        assert (camera.cx, camera.cy) == ((4 - 2) / 2, (3 - 1) / 2)

    @pytest.mark.parametrize('focal', [0.0, -1.0, np.nan, np.inf])
    def test_an_uncalibrated_camera_is_refused(self, focal):
        for rectified in (False, True):
            with refused('uncalibrated', 'not calibrated'):
                messages.camera(camera_info(focal=focal), rectified=rectified)


def stamped(rng):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


class TestPose:

    @pytest.mark.parametrize('kind', ['pose', 'pose_with_covariance', 'odometry', 'transform'])
    def test_each_kind_gives_frames_stamp_and_matrix(self, kind):
        T = stamped(np.random.default_rng(5))
        item = messages.pose(pose_message(kind, 12_000_000_034, T, '/map', '/base'), kind)
        has_child = kind in ('odometry', 'transform')
        assert item[:3] == ('map', 'base' if has_child else '', 12_000_000_034)
        np.testing.assert_allclose(item.T_parent_child, T, atol=1e-12)

    def changed(self, **fields):
        msg = pose_message('pose', 2_500_000_000, np.eye(4))
        for name, value in fields.items():
            part = msg.pose.position if name.startswith('p') else msg.pose.orientation
            setattr(part, name[1:], value)
        return msg

    def test_quaternions_written_by_hand_are_normalised(self):
        T = messages.pose(self.changed(qz=0.707, qw=0.707), 'pose').T_parent_child
        np.testing.assert_allclose(T[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)

    @pytest.mark.parametrize(('fields', 'match'), [
        ({'qw': 0.0}, 'quaternion of length 0, not 1'),
        ({'qw': 0.5}, 'quaternion of length 0.5, not 1'),
        ({'qx': np.nan}, 'not finite'),
        ({'px': np.nan}, 'not finite'),
        ({'px': 1e300}, 'a position 1e.300 m away'),
        ({'pz': np.inf}, 'not finite'),
        ({'qw': np.inf}, 'not finite'),
        ({'qw': 1e200}, 'quaternion of length 1e.200, not 1'),
    ])
    def test_what_is_no_pose_is_refused(self, fields, match):
        with refused('bad_pose', f"the camera in 'map' at 2.500 s has .*{match}"):
            messages.pose(self.changed(**fields), 'pose')

    def test_tf_messages_keep_their_good_transforms(self):
        T = stamped(np.random.default_rng(6))
        bad = transform('map', 'bad', 5, T)
        bad.transform.rotation.w = np.nan
        items = messages.transforms(tf(bad, transform('map', 'good', 7, T)))
        assert [item.child for item in items] == ['bad', 'good']
        assert np.isnan(items[0].T_parent_child).all()
        np.testing.assert_allclose(items[1].T_parent_child, T, atol=1e-12)
