# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
ROS messages to numpy.

Whatever has a message's fields will do: rclpy's messages, and those that rosbags reads from
recordings, ROS 1's included. Nothing here trusts a message's numbers.
"""
from __future__ import annotations

from collections.abc import Callable
from math import hypot, isfinite
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.camera import Camera
from ..core.poses import plain, Pose, seconds
from ..errors import FrameError
from . import depth_codecs

MAX_BYTES = 5 * depth_codecs.MAX_PIXELS  # of an image's message, padding and all
_TYPES = {'16UC1': 'u2', 'mono16': 'u2', '32FC1': 'f4'}
_KNOWN = '16UC1 and mono16 (millimetres), 32FC1 (metres)'
_NO_RETURN = 65535  # with 0: how drivers write "no depth" in whole millimetres
# hand-written quaternions have two decimals, and many nodes compute in single precision
_MAX_QUATERNION_ERROR = 0.01
_MAX_DISTANCE = 1e9  # m; farther than the Moon
_MAX_COEFFICIENTS = 100  # of a distortion; OpenCV's models have 14 at most
_MAX_NAME = 256  # characters of a frame's name that count

_CONFIG = struct.Struct('<iff')  # compressedDepth: format, depth quantisation A and B


class StampedPose(NamedTuple):
    """
    A pose out of a message.

    :param parent: frame, without leading slash; likewise child, '' where the message has none
    :param stamp_ns: nanoseconds
    :param T_parent_child: (4, 4) float64, metres
    """

    parent: str
    child: str
    stamp_ns: int
    T_parent_child: Pose


def stamp_ns(header: Any) -> int:
    """
    Return a header's stamp in nanoseconds.

    :param header: std_msgs/Header
    """
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def frame_name(text: str) -> str:
    """Return a frame's name, without leading slash, and not endless."""
    return plain(text[:_MAX_NAME])


def check_size(msg: Any) -> None:
    """
    Refuse an image that is too large to be decoded, or to be kept until it is.

    :param msg: sensor_msgs/Image or CompressedImage
    :raises FrameError: if its data are larger than any depth image's
    """
    if len(msg.data) > MAX_BYTES:
        raise FrameError(
            'image_size', f'an image has {len(msg.data) / 1e6:.0f} MB of data; up to '
            f'{MAX_BYTES / 1e6:.0f} are taken')


def size(msg: Any) -> tuple[int, int]:
    """
    Return a depth image's height and width, pixels, as its header says; (0, 0): it cannot tell.

    :param msg: as for depth
    """
    if not hasattr(msg, 'format'):
        return int(msg.height), int(msg.width)
    head = bytes(msg.data[_CONFIG.size:_CONFIG.size + depth_codecs.HEAD])
    return depth_codecs.size(head, rvl='rvl' in str(msg.format)[:60])


def depth(msg: Any) -> NDArray[np.float32]:
    """
    Read a depth image.

    :param msg: sensor_msgs/Image, or sensor_msgs/CompressedImage of compressedDepth
    :return: (h, w) float32, metres, NaN where invalid
    :raises FrameError: see check_size, depth_image, compressed_depth
    """
    check_size(msg)
    return compressed_depth(msg) if hasattr(msg, 'format') else depth_image(msg)


def depth_image(msg: Any) -> NDArray[np.float32]:
    """
    Read a depth image.

    :param msg: sensor_msgs/Image: 16UC1 or mono16 in millimetres, 32FC1 in metres
    :return: (h, w) float32, metres, NaN where invalid
    :raises FrameError: if its encoding is another, or its sizes do not fit each other
    """
    encoding = _encoding(msg.encoding)
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    depth_codecs.check_size(height, width)
    dtype = np.dtype(('>' if msg.is_bigendian else '<') + _TYPES[encoding])
    row = width * dtype.itemsize
    if step < row:
        raise FrameError(
            'image_size', f'depth image {width}x{height} {encoding} has step {step}, but a row '
            f'takes {row} bytes: its publisher writes wrong headers')
    need = step * (height - 1) + row
    if len(msg.data) < need:
        raise FrameError(
            'image_size', f'depth image {width}x{height} {encoding} with step {step} has '
            f'{len(msg.data)} bytes of data where it needs {need}: it was cut off')
    raw = np.ndarray((height, width), dtype, msg.data, strides=(step, dtype.itemsize))
    return _metres(raw)


def compressed_depth(msg: Any) -> NDArray[np.float32]:
    """
    Decompress a depth image of image_transport's compressedDepth.

    :param msg: sensor_msgs/CompressedImage with format '16UC1; compressedDepth png' or alike:
        16UC1 or 32FC1, png (where none is named) or rvl
    :return: (h, w) float32, metres, NaN where invalid
    :raises FrameError: if the format is another, or the data are damaged
    """
    encoding, _, compression = str(msg.format).partition(';')
    encoding = _encoding(encoding.strip())
    decode = _DECODERS.get(compression.strip())
    if decode is None:
        raise FrameError(
            'encoding', f'compressed depth image has format {str(msg.format)[:60]!r}; known are '
            '16UC1 and 32FC1 with "compressedDepth png" or "compressedDepth rvl"')
    data = bytes(msg.data)
    if len(data) < _CONFIG.size:
        raise depth_codecs.damaged(f'{len(data)} bytes of data')
    _, a, b = _CONFIG.unpack_from(data)
    raw = decode(data[_CONFIG.size:])
    if encoding != '32FC1':
        return _metres(raw)
    # quantised inverse depth, as compressed_depth_image_transport writes it
    with np.errstate(divide='ignore', invalid='ignore'):
        metres = np.float32(a) / (raw.astype(np.float32) - np.float32(b))
    metres[raw == 0] = np.nan
    return _metres(metres)


def mask(msg: Any) -> NDArray[np.bool_]:
    """
    Read a mask.

    :param msg: sensor_msgs/Image of mono8 or 8UC1
    :return: (h, w) bool, true where a pixel is to be ignored: where it is not 0
    :raises FrameError: if it has another encoding, is too large or was cut off
    """
    check_size(msg)
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    if msg.encoding not in ('mono8', '8UC1'):
        raise FrameError(
            'mask', f'the mask has encoding {str(msg.encoding)[:40]!r}; mono8 and 8UC1 are known')
    if height <= 0 or width <= 0 or height * width > depth_codecs.MAX_PIXELS or step < width or (
            len(msg.data) < step * (height - 1) + width):
        raise FrameError('mask', f'the mask of {width}x{height} pixels with step {step} has '
                         f'{len(msg.data)} bytes of data: its publisher writes wrong headers')
    raw = np.ndarray((height, width), np.uint8, msg.data, strides=(step, 1))
    result: NDArray[np.bool_] = raw != 0
    return result


def camera(msg: Any, *, rectified: bool) -> Camera:
    """
    Read a camera.

    :param msg: sensor_msgs/CameraInfo
    :param rectified: whether the images are rectified
    :raises FrameError: see Camera
    """
    # ROS 1 has these names in capitals
    K, D, P = (getattr(msg, name if hasattr(msg, name) else name.upper()) for name in 'kdp')
    if len(D) > _MAX_COEFFICIENTS:
        raise FrameError(
            'distortion_model', f'camera_info has {len(D)} distortion coefficients; no model has '
            'so many: its publisher writes wrong messages')
    roi = msg.roi
    return Camera.from_camera_info(
        int(msg.width), int(msg.height), K, D, P, str(msg.distortion_model), rectified=rectified,
        roi=(int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
        binning=(int(msg.binning_x), int(msg.binning_y)))


def pose(msg: Any, kind: str) -> StampedPose:
    """
    Read a pose message.

    :param msg: the message that `kind` names
    :param kind: pose, pose_with_covariance, odometry or transform, as Settings.pose_source
    :raises FrameError: if its numbers are not finite or absurd, or its quaternion is far from
        length 1
    """
    header = msg.header
    if kind == 'transform':
        position, rotation = msg.transform.translation, msg.transform.rotation
    else:
        inner = msg.pose if kind == 'pose' else msg.pose.pose
        position, rotation = inner.position, inner.orientation
    parent = frame_name(header.frame_id)
    child = frame_name(getattr(msg, 'child_frame_id', ''))
    stamp = stamp_ns(header)
    numbers = (position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w)
    norm = hypot(*numbers[3:])
    away = max(map(abs, numbers[:3]))
    if not (abs(norm - 1) <= _MAX_QUATERNION_ERROR and all(map(isfinite, numbers))
            and away <= _MAX_DISTANCE):
        what = 'has numbers that are not finite' if not all(map(isfinite, numbers)) else (
            f'has a position {away:.3g} m away' if away > _MAX_DISTANCE
            else f'has a quaternion of length {norm:.3g}, not 1')
        raise FrameError(
            'bad_pose', f'the pose of {child or "the camera"} in {parent!r} at {seconds(stamp)} '
            f'{what}: images at that time are left out')
    T = _matrix(*numbers[:3], *(q / norm for q in numbers[3:]))
    return StampedPose(parent, child, stamp, T)


def transforms(msg: Any) -> list[StampedPose]:
    """
    Read a tf message.

    :param msg: tf2_msgs/TFMessage
    :return: its transforms; T_parent_child is NaN where the numbers are no pose (see pose)
    """
    result = []
    for item in msg.transforms:
        try:
            result.append(pose(item, 'transform'))
        except FrameError:
            result.append(unknown_pose(item))
    return result


def unknown_pose(msg: Any) -> StampedPose:
    """
    Return the frames and the stamp of a pose message, with a pose of NaN.

    :param msg: any message that `pose` takes
    """
    return StampedPose(
        frame_name(msg.header.frame_id), frame_name(getattr(msg, 'child_frame_id', '')),
        stamp_ns(msg.header), np.full((4, 4), np.nan))


def _matrix(
    px: float, py: float, pz: float, x: float, y: float, z: float, w: float
) -> Pose:
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), px],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), py],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), pz],
        [0.0, 0.0, 0.0, 1.0]])


def _encoding(encoding: str) -> str:
    if encoding not in _TYPES:
        raise FrameError(
            'encoding', f'depth image has encoding {str(encoding)[:40]!r}; known are {_KNOWN}: '
            'choose the topic of the depth images, or convert it')
    return encoding


def _metres(raw: NDArray[Any]) -> NDArray[np.float32]:
    """Return float32 metres of whole millimetres or floating metres, NaN where invalid."""
    if raw.dtype.kind == 'u':
        metres: NDArray[np.float32] = np.divide(raw, np.float32(1000), dtype=np.float32)
        metres[(raw == 0) | (raw == _NO_RETURN)] = np.nan
    else:
        metres = raw.astype(np.float32)
        metres[~((metres > 0) & (metres < np.inf))] = np.nan
    return metres


_DECODERS: dict[str, Callable[[bytes], NDArray[np.uint16]]] = {
    '': depth_codecs.png, 'compressedDepth': depth_codecs.png,
    'compressedDepth png': depth_codecs.png, 'compressedDepth rvl': depth_codecs.rvl}
