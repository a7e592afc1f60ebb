# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes of the map: markers, a point cloud and images."""
from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
import time

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2, PointField
from visualization_msgs.msg import MarkerArray

from ..core.colour import Colouring
from ..core.reconstruction import Reconstruction
from ..core.shading import triangle_corners
from ..core.view_mesh import ViewMesh
from ..io.cdr import Marker, marker_array, no_markers
from ..settings import Settings
from .images import ImagePublishers
from .timings import Timings

NAMESPACE, EDGES = 'mesh', 'edges'
MAX_POINTS = 2_000_000
_MAX_CORNERS = 400_000  # in one message: 16 MB; what is over goes with the next
_MAX_SECONDS = 0.25  # for making one message
_LINE = 0.1  # width of a line, of the median edge
_NEW_COLOURS = 0.2  # change of the colour scale with which all meshes are sent again
_POINT = np.dtype([
    ('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('rgb', '<u4'), ('likelihood', '<f4'),
    ('sigma', '<f4'), ('confidence', '<f4')])


class MapPublishers:
    """
    The topics ~/mesh, ~/edges, ~/points, and those of ImagePublishers.

    One TRIANGLE_LIST for each keyframe; one LINE_LIST for each, every edge in its own likelihood's
    colour; the vertices of all of them.

    Meshes that changed are sent again, those that wait longest first, as many as fit one message;
    all of them where someone new listens. Nothing is computed while nobody does.

    :param node: on which to advertise
    :param settings: display_stride and shading count
    :param timings: learns how long things take
    """

    def __init__(
        self, node: Node, settings: Settings, timings: Timings | None = None
    ) -> None:
        self._settings = settings
        self._timings = timings or Timings()
        self._mesh = node.create_publisher(MarkerArray, '~/mesh', outputs_profile(5))
        self._points = node.create_publisher(PointCloud2, '~/points', outputs_profile(1))
        self._edges = node.create_publisher(MarkerArray, '~/edges', outputs_profile(5))
        self._images = ImagePublishers(node, outputs_profile(1), self._timings)
        self._listeners = {self._mesh: 0, self._points: 0, self._edges: 0}
        self._waiting: dict[int, None] = {}  # keyframes, in order
        self._clouds: dict[int, NDArray[np.void]] = {}  # of each keyframe; see cloud
        self._shown = 0.0  # what the scale of the last colours stood for

    def update(self, settings: Settings) -> None:
        """Take parameters that may change."""
        self._settings = settings

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
        everything = dict.fromkeys(range(len(reconstruction.keyframes)))
        appeared = [self._appeared(publisher) for publisher in self._listeners]
        if any(appeared):
            self._waiting.update(everything)
        if not any(self._listeners.values()):
            self._clouds.clear()
            return sent
        if not self._waiting:
            return sent
        colouring = reconstruction.colouring()
        # likelihoods are shares of the number of views; what they are shares of is compared
        shown = colouring.scale * (views if colouring.by == 'likelihood' else 1)
        if abs(shown - self._shown) > _NEW_COLOURS * self._shown:
            self._shown = shown
            self._waiting.update(everything)
        with self._timings.measure('mesh'):
            meshes = self._take(reconstruction)
        with self._timings.measure('publish', cpu=True):
            self._send(meshes, frame_id, stamp_ns, views, colouring)
        return True

    def _send(
        self, meshes: dict[int, ViewMesh], frame_id: str, stamp_ns: int, views: int,
        colouring: Colouring,
    ) -> None:
        if self._listeners[self._mesh]:
            self._mesh.publish(marker_array(frame_id, NAMESPACE, [
                triangles(keyframe, mesh, colouring, self._settings.shading)
                for keyframe, mesh in meshes.items()]))
        if self._listeners[self._edges]:
            self._edges.publish(marker_array(frame_id, EDGES, [
                lines(keyframe, mesh, colouring)
                for keyframe, mesh in meshes.items()]))
        if self._listeners[self._points]:
            self._clouds.update(
                (keyframe, cloud(mesh, views)) for keyframe, mesh in meshes.items())
            self._send_points(
                point_cloud([*self._clouds.values()], views, colouring), frame_id, stamp_ns)

    def clear(self, frame_id: str) -> None:
        """Take back all that was sent, also from those who come late."""
        self._waiting.clear()
        self._clouds.clear()
        self._shown = 0.0
        self._mesh.publish(no_markers(frame_id, NAMESPACE))
        self._edges.publish(no_markers(frame_id, EDGES))
        self._send_points(point_cloud([], 0, Colouring('', 0.0, 'turbo')), frame_id, 0)

    def _appeared(self, publisher: Publisher) -> bool:
        before = self._listeners[publisher]
        self._listeners[publisher] = publisher.get_subscription_count()
        return self._listeners[publisher] > before

    def _take(self, reconstruction: Reconstruction) -> dict[int, ViewMesh]:
        """Return the meshes that are to be sent now."""
        meshes: dict[int, ViewMesh] = {}
        corners = 0
        end = time.monotonic() + _MAX_SECONDS
        while self._waiting and corners < _MAX_CORNERS and time.monotonic() < end:
            keyframe = next(iter(self._waiting))
            del self._waiting[keyframe]
            meshes[keyframe] = reconstruction.mesh(keyframe, self._settings.display_stride)
            corners += meshes[keyframe].faces.size
        return meshes

    def _send_points(self, message: PointCloud2, frame_id: str, stamp_ns: int) -> None:
        message.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        message.header.frame_id = frame_id
        self._points.publish(message)


def outputs_profile(depth: int) -> QoSProfile:
    """Return the QoS of all outputs: whoever comes late gets the last messages."""
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL)


def triangles(marker: int, mesh: ViewMesh, colouring: Colouring, shading: bool) -> Marker:
    """
    Return a mesh as a marker has it: each triangle's three corners written out.

    :param shading: whether faces turned away from a light of the world are darker: viewers do not
        light what has colours of its own, and without it no shape is seen
    """
    colour = colouring.colours(mesh.vertex_likelihood, mesh.vertex_sigma)
    return Marker(marker, *triangle_corners(mesh.vertices, mesh.faces, colour, shading))


def lines(marker: int, mesh: ViewMesh, colouring: Colouring) -> Marker:
    """Return a mesh's edges as a marker has them."""
    points = mesh.vertices[mesh.edges.reshape(-1)]
    lengths = np.linalg.norm(points[1::2] - points[::2], axis=1)
    colour = colouring.edge_colours(mesh.edge_likelihood, mesh.vertex_sigma, mesh.edges)
    width = _LINE * float(np.median(lengths)) if len(lengths) else 1.0
    return Marker(marker, points, np.repeat(colour, 2, axis=0), width)


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
    message = PointCloud2()
    message.height = 1
    message.width = len(points)
    # viewers expect the three bytes of rgb under the name of a float32
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate(_POINT.names or ())]
    message.point_step = _POINT.itemsize
    message.row_step = points.nbytes
    message.is_dense = True
    message.data = array('B', points.tobytes())
    return message
