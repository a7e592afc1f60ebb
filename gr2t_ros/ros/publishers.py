# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes of the map: meshes, points and images."""
from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from ..core.colour import Colouring
from ..core.reconstruction import Reconstruction
from ..core.view_mesh import ViewMesh
from ..io.cdr import marker_array, no_markers
from ..settings import Settings
from .fused import FusedPublishers
from .images import ImagePublishers
from .outputs import cloud_message, lines, Output, outputs_profile, Shown, taken, triangles
from .timings import Timings

NAMESPACE, EDGES = 'mesh', 'edges'
MAX_POINTS = 2_000_000
_POINT = np.dtype([
    ('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('rgb', '<u4'), ('likelihood', '<f4'),
    ('sigma', '<f4'), ('confidence', '<f4')])


class MapPublishers:
    """
    The topics ~/mesh, ~/edges, ~/points, and those of FusedPublishers and ImagePublishers.

    One TRIANGLE_LIST for each keyframe; one LINE_LIST for each, every edge in its own likelihood's
    colour; the vertices of all of them.

    Meshes that changed are sent again, those that wait longest first, as many as fit one message;
    all of them where someone new listens. Nothing is computed while nobody does.

    :param node: on which to advertise
    :param settings: display_stride, shading and publish_views count
    :param timings: learns how long things take
    """

    def __init__(
        self, node: Node, settings: Settings, timings: Timings | None = None
    ) -> None:
        self._settings = settings
        self._timings = timings or Timings()
        self._mesh = Output(node, MarkerArray, '~/mesh', 5, offered=settings.publish_views)
        self._edges = Output(node, MarkerArray, '~/edges', 5, offered=settings.publish_views)
        self._points = Output(node, PointCloud2, '~/points', 1)
        self._fused = FusedPublishers(node, settings, self._timings)
        self._images = ImagePublishers(node, outputs_profile(1), self._timings)
        self._waiting: dict[int, None] = {}  # keyframes, in order
        self._clouds: dict[int, NDArray[np.void]] = {}  # of each keyframe; see cloud
        self._shown = Shown()

    def update(self, settings: Settings) -> None:
        """Take parameters that may change."""
        self._settings = settings
        self._fused.update(settings)

    def change(self, keyframes: Iterable[int]) -> None:
        """Note keyframes whose meshes changed."""
        changed = dict.fromkeys(keyframes)
        self._waiting.update(changed)
        self._images.change(changed)

    def publish(
        self, reconstruction: Reconstruction, frame_id: str, stamp_ns: int, views: int
    ) -> bool:
        """
        Send what changed to whoever listens; tell whether something was sent.

        :param frame_id: the world frame
        :param stamp_ns: of the newest image in the map
        :param views: in the map
        """
        sent = self._images.publish(reconstruction)
        sent |= self._fused.publish(reconstruction, frame_id, stamp_ns, views)
        outputs = (self._mesh, self._edges, self._points)
        everything = dict.fromkeys(range(len(reconstruction.keyframes)))
        appeared = [output.appeared() for output in outputs]
        if any(appeared):
            self._waiting.update(everything)
        if not any(output.listeners for output in outputs):
            self._clouds.clear()
            return sent
        if not self._waiting:
            return sent
        colouring = reconstruction.colouring()
        if self._shown.differs(colouring, views):
            self._waiting.update(everything)
        with self._timings.measure('mesh'):
            meshes = taken(self._waiting, lambda keyframe: reconstruction.mesh(
                keyframe, self._settings.display_stride))
        with self._timings.measure('publish', cpu=True):
            self._send(meshes, frame_id, stamp_ns, views, colouring)
        return True

    def _send(
        self, meshes: dict[int, ViewMesh], frame_id: str, stamp_ns: int, views: int,
        colouring: Colouring,
    ) -> None:
        if self._mesh.listeners:
            self._mesh.publish(marker_array(frame_id, NAMESPACE, [
                triangles(keyframe, mesh, colouring, self._settings.shading)
                for keyframe, mesh in meshes.items()]))
        if self._edges.listeners:
            self._edges.publish(marker_array(frame_id, EDGES, [
                lines(keyframe, mesh, colouring)
                for keyframe, mesh in meshes.items()]))
        if self._points.listeners:
            self._clouds.update(
                (keyframe, cloud(mesh, views)) for keyframe, mesh in meshes.items())
            self._send_points(
                point_cloud([*self._clouds.values()], views, colouring), frame_id, stamp_ns)

    def clear(self, frame_id: str) -> None:
        """Take back all that was sent, also from those who come late."""
        self._waiting.clear()
        self._clouds.clear()
        self._shown = Shown()
        self._fused.clear(frame_id)
        self._mesh.publish(no_markers(frame_id, NAMESPACE))
        self._edges.publish(no_markers(frame_id, EDGES))
        self._send_points(point_cloud([], 0, Colouring('', 0.0, 'turbo')), frame_id, 0)

    def _send_points(self, message: PointCloud2, frame_id: str, stamp_ns: int) -> None:
        message.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        message.header.frame_id = frame_id
        self._points.publish(message)


def cloud(mesh: ViewMesh, views: int) -> NDArray[np.void]:
    """
    Return a mesh's vertices as points without colours.

    :param views: in the map: by so many the likelihoods are multiplied, so that they stay
        comparable with those of other meshes while views come
    """
    points = np.zeros(len(mesh.vertices), _POINT)
    for axis, name in enumerate('xyz'):
        points[name] = mesh.vertices[:, axis]
    points['likelihood'] = mesh.vertex_likelihood * views
    points['sigma'] = mesh.vertex_sigma
    points['confidence'] = mesh.vertex_confidence
    return points


def point_cloud(
    clouds: Sequence[NDArray[np.void]], views: int, colouring: Colouring
) -> PointCloud2:
    """
    Return points as a message without header: x, y, z, rgb, likelihood, sigma, confidence.

    :param clouds: of `cloud`
    :param views: in the map
    :param colouring: of rgb
    """
    points = np.concatenate([np.zeros(0, _POINT), *clouds])
    points = np.ascontiguousarray(points[::len(points) // MAX_POINTS + 1])
    points['likelihood'] /= max(views, 1)
    rgb = colouring.colours(points['likelihood'], points['sigma']).astype(np.uint32)
    points['rgb'] = rgb @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    return cloud_message(points)
