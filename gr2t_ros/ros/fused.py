# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes of the fused map: one mesh, what it lacks, where to see that from."""
from __future__ import annotations

import time

from geometry_msgs.msg import Point, Pose, PoseArray, Quaternion
import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from ..core.fused_mesh import Region
from ..core.next_views import Attention, NextView, where_next
from ..core.reconstruction import Reconstruction
from ..io.cdr import marker_array, no_markers
from ..settings import Settings
from .outputs import cloud_message, Output, Shown, taken, triangles
from .timings import Timings

NAMESPACE = 'fused_mesh'
_REST = 20.0  # times as long as a search for next views took, there is none
_PLACE = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('confidence', '<f4')])


class FusedPublishers:
    """
    The topics ~/fused_mesh, ~/attention, ~/next_views.

    One TRIANGLE_LIST for each region of the map: those that changed are sent again, those that
    wait longest first, as many as fit one message, and all where someone new listens. The other
    two follow where there is time. Nothing is computed while nobody listens.

    :param node: on which to advertise
    :param settings: shading counts
    :param timings: learns how long things take
    """

    def __init__(self, node: Node, settings: Settings, timings: Timings) -> None:
        self._settings = settings
        self._timings = timings
        self._mesh = Output(node, MarkerArray, '~/fused_mesh', 5)
        self._attention = Output(node, PointCloud2, '~/attention', 1)
        self._next_views = Output(node, PoseArray, '~/next_views', 1)
        self._waiting: dict[Region, None] = {}  # in order
        self._ids: dict[Region, int] = {}  # of the markers that were sent
        self._shown = Shown()
        self._everything = False  # whether all regions are to be sent again
        self._search = False  # whether the next views may have changed
        self._search_at = 0.0

    def update(self, settings: Settings) -> None:
        """Take parameters that may change; all that is shown follows."""
        self._settings = settings
        self._everything = True

    def publish(
        self, reconstruction: Reconstruction, frame_id: str, stamp_ns: int, views: int
    ) -> bool:
        """
        Send what changed to whoever listens; tell whether something was sent.

        :param frame_id: the world frame
        :param stamp_ns: of the newest image in the map
        :param views: in the map
        """
        self._everything |= self._mesh.appeared()
        self._search |= any([self._attention.appeared(), self._next_views.appeared()])
        looking = self._attention.listeners + self._next_views.listeners
        if not (self._mesh.listeners or looking):
            return False
        with self._timings.measure('fuse'):
            changed = reconstruction.fuse()
        self._waiting.update(dict.fromkeys(changed))
        self._search |= bool(changed)
        sent = self._mesh.listeners > 0 and self._send_mesh(reconstruction, frame_id, views)
        began = time.monotonic()
        if looking and self._search and began >= self._search_at:
            with self._timings.measure('next views'):
                found = where_next(reconstruction, reconstruction.fused_mesh())
            self._send_views(found, frame_id, stamp_ns)
            self._search = False
            end = time.monotonic()
            self._search_at = end + _REST * (end - began)
            sent = True
        return sent

    def clear(self, frame_id: str) -> None:
        """Take back all that was sent, also from those who come late."""
        self._waiting.clear()
        self._ids.clear()
        self._shown = Shown()
        self._search_at = 0.0
        self._mesh.publish(no_markers(frame_id, NAMESPACE))
        self._send_views(Attention(np.zeros((0, 3)), np.zeros(0, np.float32), ()), frame_id, 0)

    def _send_mesh(self, reconstruction: Reconstruction, frame_id: str, views: int) -> bool:
        if not (self._waiting or self._everything):
            return False
        colouring = reconstruction.colouring()
        if self._shown.differs(colouring, views) or self._everything:
            self._waiting.update(dict.fromkeys([*self._ids, *reconstruction.fused_regions]))
        self._everything = False
        with self._timings.measure('fused mesh'):
            meshes = taken(self._waiting, reconstruction.fused_region)
        with self._timings.measure('publish', cpu=True):
            # an empty one takes back what it was before, if it was anything
            markers = [
                triangles(self._ids.setdefault(region, len(self._ids)), mesh, colouring,
                          self._settings.shading)
                for region, mesh in meshes.items() if len(mesh.faces) or region in self._ids]
            if markers:
                self._mesh.publish(marker_array(frame_id, NAMESPACE, markers))
        return bool(markers)

    def _send_views(self, found: Attention, frame_id: str, stamp_ns: int) -> None:
        header = Header(stamp=Time(nanoseconds=stamp_ns).to_msg(), frame_id=frame_id)
        cloud = places(found.points, found.confidence)
        cloud.header = header
        self._attention.publish(cloud)
        self._next_views.publish(
            PoseArray(header=header, poses=[_pose(view) for view in found.views]))


def places(points: NDArray[np.float64], confidence: NDArray[np.float32]) -> PointCloud2:
    """Return points as a message without header: x, y, z, confidence."""
    rows = np.zeros(len(points), _PLACE)
    for axis, name in enumerate('xyz'):
        rows[name] = points[:, axis]
    rows['confidence'] = confidence
    return cloud_message(rows)


def _pose(view: NextView) -> Pose:
    """Return where to look from: the pose's z axis is that of the camera."""
    T = view.T_world_camera
    x, y, z, w = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())
    place = Point(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3]))
    return Pose(position=place, orientation=Quaternion(x=x, y=y, z=z, w=w))
