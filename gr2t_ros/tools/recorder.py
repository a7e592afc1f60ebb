# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Views as a bag: depth images, camera_info and tf, named as a RealSense driver names them."""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
import tempfile
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from scipy.spatial.transform import Rotation

from ..core.camera import Camera
from ..core.view import View
from ..errors import Gr2tError, InputError

DEPTH_TOPIC = '/camera/camera/depth/image_rect_raw'
CAMERA_INFO_TOPIC = '/camera/camera/depth/camera_info'
WORLD_FRAME = 'map'
CAMERA_FRAME = 'camera_link'
DEPTH_FRAME = 'camera_depth_frame'
OPTICAL_FRAME = 'camera_depth_optical_frame'

_IMAGE = 'sensor_msgs/msg/Image'
_CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
_TF = 'tf2_msgs/msg/TFMessage'
# all supported ROS distributions play this version; from 9 on humble does not
_BAG_VERSION: Literal[8] = 8
_FOREVER = QosTime(2147483647, 4294967295)
_LATCHED = Qos(
    QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL,
    _FOREVER, _FOREVER, QosLiveliness.AUTOMATIC, _FOREVER, False)
# REP 103: a link looks along x with z up, an optical frame along z with y down
_T_LINK_OPTICAL = np.array([
    [0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def record(path: Path, views: Iterable[View], encoding: str = '32FC1') -> int:
    """
    Write views into a new rosbag2 MCAP recording.

    :param path: a folder, or a bare file where it ends in .mcap; it appears once complete
    :param views: by increasing stamp
    :param encoding: of the images: 32FC1 (metres) or 16UC1 (millimetres)
    :return: the number of images
    :raises InputError: if there is such a file or folder
    :raises Gr2tError: if it cannot be written
    """
    if path.exists():
        raise InputError(f'{path} exists: remove it, or choose another name')
    bare = path.suffix == '.mcap'
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f'.{path.name}.') as scratch:
            folder = Path(scratch) / path.stem if bare else Path(scratch) / path.name
            count = _write(folder, views, encoding)
            (folder / f'{folder.name}.mcap' if bare else folder).rename(path)
    except OSError as error:
        raise Gr2tError(f'cannot write {path}: {error.strerror or error}') from error
    return count


def _write(folder: Path, views: Iterable[View], encoding: str) -> int:
    types = get_typestore(Stores.ROS2_HUMBLE)
    messages = _Messages(types.types)
    bag = Writer(folder, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
    bag.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with bag:
        tf_static = bag.add_connection(
            '/tf_static', _TF, typestore=types, offered_qos_profiles=[_LATCHED])
        tf = bag.add_connection('/tf', _TF, typestore=types)
        info = bag.add_connection(CAMERA_INFO_TOPIC, _CAMERA_INFO, typestore=types)
        image = bag.add_connection(DEPTH_TOPIC, _IMAGE, typestore=types)
        count = 0
        for view in views:
            stamp = view.stamp_ns
            if count == 0:
                bag.write(tf_static, stamp, types.serialize_cdr(messages.static(stamp), _TF))
            T_map_link = view.T_world_camera @ np.linalg.inv(_T_LINK_OPTICAL)
            pose = messages.transform(WORLD_FRAME, CAMERA_FRAME, stamp, T_map_link)
            bag.write(tf, stamp, types.serialize_cdr(messages.tf([pose]), _TF))
            bag.write(info, stamp, types.serialize_cdr(
                messages.camera_info(view.camera, stamp), _CAMERA_INFO))
            bag.write(image, stamp, types.serialize_cdr(
                messages.image(view, encoding), _IMAGE))
            count += 1
    return count


class _Messages:
    """
    The messages of a recording.

    :param types: the typestore's message classes by name
    """

    def __init__(self, types: Any) -> None:
        self._types = types

    def image(self, view: View, encoding: str) -> Any:
        depth = np.nan_to_num(view.depth, nan=0.0) if encoding == '16UC1' else view.depth
        data = (
            np.round(depth.astype(np.float64) * 1000.0).astype('<u2') if encoding == '16UC1'
            else depth.astype('<f4'))
        height, width = data.shape
        return self._types[_IMAGE](
            header=self._header(OPTICAL_FRAME, view.stamp_ns), height=height, width=width,
            encoding=encoding, is_bigendian=0, step=width * data.itemsize,
            data=data.view(np.uint8).reshape(-1))

    def camera_info(self, camera: Camera, stamp_ns: int) -> Any:
        roi = self._types['sensor_msgs/msg/RegionOfInterest'](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        K = np.array([
            [camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        return self._types[_CAMERA_INFO](
            header=self._header(OPTICAL_FRAME, stamp_ns), height=camera.height,
            width=camera.width, distortion_model='plumb_bob', d=np.zeros(5), k=K.reshape(-1),
            r=np.eye(3).reshape(-1), p=np.column_stack([K, np.zeros(3)]).reshape(-1),
            binning_x=0, binning_y=0, roi=roi)

    def static(self, stamp_ns: int) -> Any:
        return self.tf([
            self.transform(CAMERA_FRAME, DEPTH_FRAME, stamp_ns, np.eye(4)),
            self.transform(DEPTH_FRAME, OPTICAL_FRAME, stamp_ns, _T_LINK_OPTICAL)])

    def tf(self, transforms: list[Any]) -> Any:
        return self._types[_TF](transforms=transforms)

    def transform(
        self, parent: str, child: str, stamp_ns: int, T_parent_child: NDArray[np.float64]
    ) -> Any:
        x, y, z = T_parent_child[:3, 3]
        qx, qy, qz, qw = Rotation.from_matrix(T_parent_child[:3, :3]).as_quat()
        return self._types['geometry_msgs/msg/TransformStamped'](
            header=self._header(parent, stamp_ns), child_frame_id=child,
            transform=self._types['geometry_msgs/msg/Transform'](
                translation=self._types['geometry_msgs/msg/Vector3'](x=x, y=y, z=z),
                rotation=self._types['geometry_msgs/msg/Quaternion'](
                    x=qx, y=qy, z=qz, w=qw)))

    def _header(self, frame: str, stamp_ns: int) -> Any:
        return self._types['std_msgs/msg/Header'](
            stamp=self._types['builtin_interfaces/msg/Time'](
                sec=stamp_ns // 10 ** 9, nanosec=stamp_ns % 10 ** 9),
            frame_id=frame)
