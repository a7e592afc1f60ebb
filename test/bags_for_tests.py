# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Recordings of every kind, written message by message."""
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
import shutil
import sqlite3
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from scipy.spatial.transform import Rotation

DEPTH = '/camera/depth/image_rect_raw'
INFO = '/camera/depth/camera_info'
OPTICAL = 'camera_depth_optical_frame'
WIDTH, HEIGHT, FOCAL = 32, 24, 30.0
BEGIN_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
TF = 'tf2_msgs/msg/TFMessage'


@dataclass
class Message:
    """
    A message that either world's types can make.

    :param make: from Types to the message
    """

    topic: str
    kind: str
    log_ns: int
    make: Callable[['Types'], Any]


@lru_cache
def types_of(ros1: bool) -> 'Types':
    """Return the one Types of a world: making them takes time."""
    return Types(ros1)


class Types:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            self.store.register(get_types_from_msg(
                'geometry_msgs/TransformStamped[] transforms', TF))

    def new(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, frame: str, stamp_ns: int) -> Any:
        stamp = self.new('builtin_interfaces/msg/Time', sec=stamp_ns // 10 ** 9,
                         nanosec=stamp_ns % 10 ** 9)
        more = {'seq': 0} if self.ros1 else {}
        return self.new('std_msgs/msg/Header', stamp=stamp, frame_id=frame, **more)

    def xyz(self, kind: str, T: Any) -> Any:
        x, y, z = (float(v) for v in T[:3, 3])
        return self.new(f'geometry_msgs/msg/{kind}', x=x, y=y, z=z)

    def quaternion(self, T: Any, scale: float = 1.0) -> Any:
        x, y, z, w = (scale * float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat())
        return self.new('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)


def stamp(index: float) -> int:
    """Return the time of an image, nanoseconds."""
    return BEGIN_NS + round(index * PERIOD_NS)


def pose(index: float) -> Any:
    """Return (4, 4) T_map_optical: the camera moves along its x axis."""
    T = np.eye(4)
    T[0, 3] = 0.02 * index
    return T


def depth(index: int) -> Any:
    """Return (h, w) uint16 millimetres of a rough wall a metre away."""
    rng = np.random.default_rng(index)
    return (1000 + rng.integers(-2, 3, (HEIGHT, WIDTH))).astype(np.uint16)


def image(
    index: int, topic: str = DEPTH, data: Any = None, encoding: str = '16UC1',
    frame: str = OPTICAL,
) -> Message:
    """Return a depth image, logged 15 ms after its stamp."""
    data = depth(index) if data is None else data

    def make(types: Types) -> Any:
        height, width = data.shape
        return types.new(
            IMAGE, header=types.header(frame, stamp(index)), height=height, width=width,
            encoding=encoding, is_bigendian=0, step=width * data.itemsize,
            data=np.ascontiguousarray(data).view(np.uint8).reshape(-1))
    return Message(topic, IMAGE, stamp(index) + 15_000_000, make)


def camera_info(
    index: int, topic: str = INFO, width: int = WIDTH, focal: float = FOCAL,
    frame: str = OPTICAL,
) -> Message:
    """Return an image's camera_info."""
    def make(types: Types) -> Any:
        K = np.array([focal, 0, 15.5, 0, focal, 11.5, 0, 0, 1])
        P = np.array([focal, 0, 15.5, 0, 0, focal, 11.5, 0, 0, 0, 1, 0])
        arrays = {'d': np.zeros(5), 'k': K, 'r': np.eye(3).reshape(-1), 'p': P}
        if types.ros1:
            arrays = {name.upper(): value for name, value in arrays.items()}
        roi = types.new('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0,
                        width=0, do_rectify=False)
        return types.new(
            CAMERA_INFO, header=types.header(frame, stamp(index)), height=HEIGHT, width=width,
            distortion_model='plumb_bob', binning_x=0, binning_y=0, roi=roi, **arrays)
    return Message(topic, CAMERA_INFO, stamp(index) + 14_000_000, make)


def compressed(index: int, topic: str, format_: str = '16UC1; compressedDepth png') -> Message:
    """Return a compressed image whose content nobody should need."""
    def make(types: Types) -> Any:
        return types.new(COMPRESSED, header=types.header(OPTICAL, stamp(index)), format=format_,
                         data=np.zeros(20, np.uint8))
    return Message(topic, COMPRESSED, stamp(index) + 16_000_000, make)


def transform(
    index: float, parent: str = 'map', child: str = 'camera_link', T: Any = None,
    static: bool = False, topic: str = '', scale: float = 1.0,
) -> Message:
    """Return a tf message; scale: of its quaternion."""
    T = pose(index) if T is None else T

    def make(types: Types) -> Any:
        inner = types.new('geometry_msgs/msg/Transform', translation=types.xyz('Vector3', T),
                          rotation=types.quaternion(T, scale))
        item = types.new(
            'geometry_msgs/msg/TransformStamped', header=types.header(parent, stamp(index)),
            child_frame_id=child, transform=inner)
        return types.new(TF, transforms=[item])
    topic = topic or ('/tf_static' if static else '/tf')
    return Message(topic, TF, stamp(index) + (0 if static else 2_000_000), make)


def pose_message(index: float, kind: str = 'PoseStamped', topic: str = '/pose') -> Message:
    """Return the camera's pose in one of the four kinds of messages."""
    T = pose(index)

    def make(types: Types) -> Any:
        header = types.header('map', stamp(index))
        if kind == 'TransformStamped':
            inner = types.new('geometry_msgs/msg/Transform', translation=types.xyz('Vector3', T),
                              rotation=types.quaternion(T))
            return types.new(f'geometry_msgs/msg/{kind}', header=header,
                             child_frame_id=OPTICAL, transform=inner)
        inner = types.new('geometry_msgs/msg/Pose', position=types.xyz('Point', T),
                          orientation=types.quaternion(T))
        if kind == 'PoseStamped':
            return types.new(f'geometry_msgs/msg/{kind}', header=header, pose=inner)
        inner = types.new('geometry_msgs/msg/PoseWithCovariance', pose=inner,
                          covariance=np.zeros(36))
        if kind == 'PoseWithCovarianceStamped':
            return types.new(f'geometry_msgs/msg/{kind}', header=header, pose=inner)
        none = types.new('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=0.0)
        twist = types.new('geometry_msgs/msg/TwistWithCovariance', covariance=np.zeros(36),
                          twist=types.new('geometry_msgs/msg/Twist', linear=none, angular=none))
        return types.new('nav_msgs/msg/Odometry', header=header, child_frame_id=OPTICAL,
                         pose=inner, twist=twist)
    package = 'nav_msgs' if kind == 'Odometry' else 'geometry_msgs'
    return Message(topic, f'{package}/msg/{kind}', stamp(index) + 2_000_000, make)


def tf_to_camera(frames: int) -> list[Message]:
    """Return transforms that lead from map to the camera at all images' stamps and beyond."""
    return [
        transform(0, 'camera_link', OPTICAL, np.eye(4), static=True),
        *(transform(index - 0.5) for index in range(frames + 2))]


def scan(frames: int = 3) -> list[Message]:
    """Return a recording that can be used: a camera that moves along a wall."""
    return [*tf_to_camera(frames), *(camera_info(i) for i in range(frames)),
            *(image(i) for i in range(frames))]


def write(path: Path, messages: Sequence[Message], kind: str = 'mcap') -> Path:
    """
    Write a recording.

    :param path: without ending
    :param kind: one of KINDS
    :return: what to open
    """
    messages = sorted(messages, key=lambda message: message.log_ns)
    if kind.startswith('rosbag1'):
        return _write1(path.with_suffix('.bag'), messages, kind)
    plugin = StoragePlugin.SQLITE3 if kind.startswith('sqlite3') else StoragePlugin.MCAP
    types = types_of(ros1=False)
    writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
    for name, mode in (('file', CompressionMode.FILE), ('message', CompressionMode.MESSAGE),
                       ('storage', CompressionMode.STORAGE)):
        if kind.endswith(f'{name} zstd'):
            writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        _fill(writer, messages, types, types.store.serialize_cdr)
    if kind == 'sqlite3 old':
        _forget_types(path / f'{path.name}.db3')
    if kind.endswith('bare'):
        suffix = '.db3' if plugin == StoragePlugin.SQLITE3 else '.mcap'
        bare = path.with_name(f'{path.name}_bare{suffix}')
        (path / f'{path.name}{suffix}').rename(bare)
        shutil.rmtree(path)
        return bare
    return path


KINDS = (
    'rosbag1', 'rosbag1 bz2', 'rosbag1 lz4', 'sqlite3', 'sqlite3 file zstd',
    'sqlite3 message zstd', 'sqlite3 bare', 'sqlite3 old', 'mcap', 'mcap file zstd',
    'mcap message zstd', 'mcap storage zstd', 'mcap bare')


def _write1(path: Path, messages: Sequence[Message], kind: str) -> Path:
    types = types_of(ros1=True)
    writer = rosbag1.Writer(path)
    if kind != 'rosbag1':
        writer.set_compression(rosbag1.Writer.CompressionFormat[kind.split()[1].upper()])
    with writer:
        _fill(writer, messages, types, types.store.serialize_ros1)
    return path


def _fill(writer: Any, messages: Sequence[Message], types: Types, serialize: Any) -> None:
    connections: dict[str, Any] = {}
    for message in messages:
        if message.topic not in connections:
            connections[message.topic] = writer.add_connection(
                message.topic, message.kind, typestore=types.store)
        writer.write(connections[message.topic], message.log_ns,
                     serialize(message.make(types), message.kind))


def _forget_types(file: Path) -> None:
    """Make a recording one of ROS 2 before Iron, which holds no message definitions."""
    with sqlite3.connect(file) as database:
        database.execute('DROP TABLE message_definitions')
        database.execute('DROP TABLE schema')
    database.close()
