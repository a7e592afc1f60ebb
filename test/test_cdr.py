# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Marker messages written by numpy are those that rclpy's own serialiser writes."""
import numpy as np
import pytest

from gr2t_ros.io import cdr
from gr2t_ros.io.cdr import marker_array, no_markers

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from geometry_msgs.msg import Point
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray


def reference(frame_id: str, namespace: str, meshes: list[cdr.Marker], action: int) -> MarkerArray:
    """Return the message as Python objects."""
    array = MarkerArray()
    for mesh in meshes:
        marker = Marker(ns=namespace, id=mesh.id, type=Marker.TRIANGLE_LIST, frame_locked=True)
        if mesh.width is not None:
            marker.type = Marker.LINE_LIST
        marker.header.frame_id = frame_id
        marker.action = action if len(mesh.points) == 0 else Marker.ADD
        marker.pose.orientation.w = marker.color.a = 1.0
        marker.scale.x = marker.scale.y = marker.scale.z = 1.0
        if mesh.width is not None:
            marker.scale.x = mesh.width
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in mesh.points.tolist()]
        rgb = (mesh.colours / np.float32(255)).astype(np.float32)
        marker.colors = [ColorRGBA(r=r, g=g, b=b, a=1.0) for r, g, b in rgb.tolist()]
        array.markers.append(marker)
    return array


def meshes(*sizes: int, width: float | None = None) -> list[cdr.Marker]:
    """Return meshes with so many corners each."""
    rng = np.random.default_rng(0)
    return [
        cdr.Marker(7 * i, rng.normal(size=(n, 3)), rng.integers(0, 256, (n, 3), np.uint8), width)
        for i, n in enumerate(sizes)]


@pytest.mark.parametrize('sizes', [(), (0,), (3,), (30, 0, 6), (3, 3, 3), (30_000,)])
@pytest.mark.parametrize('width', [None, 0.0123], ids=['triangles', 'lines'])
@pytest.mark.parametrize('frame_id', ['', 'map', 'odom', 'world', 'camera_link_é'])
def test_the_bytes_are_rclpys(
    sizes: tuple[int, ...], frame_id: str, width: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for the padding, which rclpy does not write: there is anything in it."""
    given = meshes(*sizes, width=width)
    ours = marker_array(frame_id, 'mesh', given)
    expected = reference(frame_id, 'mesh', given, Marker.DELETE)
    theirs = serialize_message(expected)
    assert len(ours) == len(theirs)
    monkeypatch.setattr(
        cdr._Message, '_align', lambda self, size: self._append(b'\xff' * (-self._size % size)))
    written = _bytes(ours) == _bytes(marker_array(frame_id, 'mesh', given))
    assert (_bytes(ours)[written] == _bytes(theirs)[written]).all()
    assert deserialize_message(ours, MarkerArray) == expected


def test_all_are_deleted() -> None:
    expected = reference('map', 'mesh', [*meshes(0)], Marker.DELETEALL)
    assert deserialize_message(no_markers('map', 'mesh'), MarkerArray) == expected


def _bytes(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)
