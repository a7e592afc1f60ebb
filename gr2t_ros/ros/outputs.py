# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the publishers of the map share: topics and who listens, colours, meshes as markers."""
from __future__ import annotations

from array import array
from collections.abc import Callable
import time
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField

from ..core.colour import Colouring
from ..core.fused_mesh import SurfaceMesh
from ..core.shading import triangle_corners
from ..core.view_mesh import ViewMesh
from ..io.cdr import Marker

Key = TypeVar('Key')
Mesh = TypeVar('Mesh', ViewMesh, SurfaceMesh)

_MAX_CORNERS = 400_000  # in one message: 16 MB; what is over goes with the next
_MAX_SECONDS = 0.25  # for making one message
_LINE = 0.1  # width of a line, of the median edge
_NEW_COLOURS = 0.2  # change of the colour scale with which all meshes are sent again


def outputs_profile(depth: int) -> QoSProfile:
    """Return the QoS of all outputs: whoever comes late gets the last messages."""
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Output:
    """
    A topic that keeps the last messages for who comes late.

    :param kind: of the messages
    :param depth: how many it keeps
    :param offered: whether there is the topic at all; to one that is not nobody listens

    `listeners` are those that `appeared` has counted.
    """

    def __init__(
        self, node: Node, kind: type[Any], topic: str, depth: int, *, offered: bool = True
    ) -> None:
        self._publisher = (
            node.create_publisher(kind, topic, outputs_profile(depth)) if offered else None)
        self.listeners = 0

    def appeared(self) -> bool:
        """Count who listens; tell whether there are more than the last time."""
        before = self.listeners
        if self._publisher is not None:
            self.listeners = self._publisher.get_subscription_count()
        return self.listeners > before

    def publish(self, message: Any) -> None:
        """Send a message, or its bytes."""
        if self._publisher is not None:
            self._publisher.publish(message)


class Shown:
    """What the colours stood for in what was sent last."""

    def __init__(self) -> None:
        self._scale = 0.0

    def differs(self, colouring: Colouring, views: int) -> bool:
        """
        Tell whether one would see that colours now stand for something else, and remember it.

        :param views: in the map: likelihoods are shares of them, and what these are of is compared
        """
        scale = colouring.scale * (views if colouring.by == 'likelihood' else 1)
        differs = abs(scale - self._scale) > _NEW_COLOURS * self._scale
        if differs:
            self._scale = scale
        return differs


def taken(waiting: dict[Key, None], mesh_of: Callable[[Key], Mesh]) -> dict[Key, Mesh]:
    """Take as many meshes out of those that wait as one message holds, the first ones first."""
    meshes: dict[Key, Mesh] = {}
    corners = 0
    end = time.monotonic() + _MAX_SECONDS
    while waiting and corners < _MAX_CORNERS and time.monotonic() < end:
        key = next(iter(waiting))
        del waiting[key]
        meshes[key] = mesh_of(key)
        corners += meshes[key].faces.size
    return meshes


def triangles(
    marker: int, mesh: ViewMesh | SurfaceMesh, colouring: Colouring, shading: bool
) -> Marker:
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


def cloud_message(points: NDArray[np.void]) -> PointCloud2:
    """
    Return points as a message without header.

    :param points: (n,) of fields of four bytes each; rgb holds red, green and blue
    """
    message = PointCloud2()
    message.height = 1
    message.width = len(points)
    # viewers expect the three bytes of rgb under the name of a float32
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate(points.dtype.names or ())]
    message.point_step = points.dtype.itemsize
    message.row_step = points.nbytes
    message.is_dense = True
    message.data = array('B', points.tobytes())
    return message
