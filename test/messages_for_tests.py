# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Messages for tests, as rosbags reads them from a recording."""
from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys import get_typestore, Stores
from scipy.spatial.transform import Rotation

TYPES = get_typestore(Stores.ROS2_HUMBLE)


def make(name: str, **fields: Any) -> Any:
    """Return a message, by the last part of its type's name."""
    return next(kind for key, kind in TYPES.types.items() if key.endswith(f'/{name}'))(**fields)


def header(stamp_ns: int = 0, frame: str = 'camera') -> Any:
    """Return a Header."""
    stamp = make('Time', sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make('msg/Header', stamp=stamp, frame_id=frame)


def image(
    pixels: Any, encoding: str = '16UC1', stamp_ns: int = 0, frame: str = 'camera',
    **changed: Any,
) -> Any:
    """Return an Image of a 2d array; some fields may be changed."""
    pixels = np.ascontiguousarray(pixels)
    fields = {
        'height': pixels.shape[0], 'width': pixels.shape[1], 'encoding': encoding,
        'is_bigendian': 0, 'step': pixels.strides[0], 'data': pixels.reshape(-1).view(np.uint8)}
    return make('msg/Image', header=header(stamp_ns, frame), **{**fields, **changed})


def compressed(fmt: str, data: bytes, stamp_ns: int = 0, frame: str = 'camera') -> Any:
    """Return a CompressedImage."""
    return make('CompressedImage', header=header(stamp_ns, frame), format=fmt,
                data=np.frombuffer(data, np.uint8))


def camera_info(
    width: int = 8, height: int = 6, focal: float = 10.0, stamp_ns: int = 0,
    frame: str = 'camera', **changed: Any,
) -> Any:
    """Return a CameraInfo without distortion; some fields may be changed."""
    K = np.array([focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1.0])
    P = np.array([focal, 0, width / 2, 0, 0, focal, height / 2, 0, 0, 0, 1.0, 0])
    roi = make('RegionOfInterest', x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    fields = {
        'height': height, 'width': width, 'distortion_model': 'plumb_bob', 'd': np.zeros(5),
        'k': K, 'r': np.eye(3).ravel(), 'p': P, 'binning_x': 0, 'binning_y': 0, 'roi': roi}
    return make('CameraInfo', header=header(stamp_ns, frame), **{**fields, **changed})


def _parts(T: Any) -> tuple[Any, Any]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return T[:3, 3], make('Quaternion', x=x, y=y, z=z, w=w)


def transform(parent: str, child: str, stamp_ns: int, T: Any) -> Any:
    """Return a TransformStamped."""
    (x, y, z), rotation = _parts(T)
    return make(
        'TransformStamped', header=header(stamp_ns, parent), child_frame_id=child,
        transform=make('msg/Transform', translation=make('Vector3', x=x, y=y, z=z),
                       rotation=rotation))


def tf(*transforms: Any) -> Any:
    """Return a TFMessage."""
    return make('TFMessage', transforms=list(transforms))


def pose(T: Any) -> Any:
    """Return a Pose."""
    (x, y, z), orientation = _parts(T)
    return make('msg/Pose', position=make('msg/Point', x=x, y=y, z=z), orientation=orientation)


def pose_message(
    kind: str, stamp_ns: int, T: Any, parent: str = 'map', child: str = ''
) -> Any:
    """Return the message that a pose_source names."""
    if kind == 'transform':
        return transform(parent, child, stamp_ns, T)
    head = header(stamp_ns, parent)
    if kind == 'pose':
        return make('PoseStamped', header=head, pose=pose(T))
    with_covariance = make('PoseWithCovariance', pose=pose(T), covariance=np.zeros(36))
    if kind == 'pose_with_covariance':
        return make('PoseWithCovarianceStamped', header=head, pose=with_covariance)
    zero = make('Vector3', x=0.0, y=0.0, z=0.0)
    twist = make('TwistWithCovariance', twist=make('msg/Twist', linear=zero, angular=zero),
                 covariance=np.zeros(36))
    return make('Odometry', header=head, child_frame_id=child, pose=with_covariance, twist=twist)
