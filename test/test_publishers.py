# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is sent when, and how points look to a viewer."""
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from gr2t_ros.core.colour import Colouring, colours
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.settings import Settings

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.serialization import deserialize_message
from ros_for_tests import Isolation, Observer
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from gr2t_ros.ros import outputs
from gr2t_ros.ros.outputs import lines, outputs_profile, triangles
from gr2t_ros.ros.publishers import cloud, MapPublishers, point_cloud

LIKELIHOOD = Colouring('likelihood', 1.0, 'turbo')


def mesh(faces: int = 2, likelihood: float = 1.0) -> ViewMesh:
    """Return a strip of triangles."""
    corners = np.arange(faces + 2)
    return ViewMesh(
        vertices=np.column_stack([corners // 2, corners % 2, 0 * corners]).astype(float),
        vertex_likelihood=np.full(len(corners), likelihood, np.float32),
        vertex_sigma=np.full(len(corners), 1e-3, np.float32),
        vertex_confidence=np.full(len(corners), 0.5, np.float32),
        faces=np.column_stack([corners[:-2], corners[1:-1], corners[2:]]).astype(np.int32),
        edges=np.zeros((0, 2), np.int32), edge_likelihood=np.zeros(0, np.float32))


class Map:
    """A reconstruction that notes for which keyframes it is asked."""

    def __init__(self, *meshes: ViewMesh) -> None:
        self.keyframes = list(meshes)
        self.asked: list[int] = []
        self.by, self.scale = 'likelihood', 1.0

    def mesh(self, keyframe: int, stride: int = 1) -> ViewMesh:
        self.asked.append(keyframe)
        return self.keyframes[keyframe]

    def colouring(self) -> Colouring:
        return Colouring(self.by, self.scale, 'turbo')


@pytest.fixture
def observer() -> Iterator[Observer]:
    observer = Observer(Isolation())
    yield observer
    observer.close()


class Viewer:
    """A subscriber of ~/mesh and the markers that it has."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self.messages = observer.collect(MarkerArray, 'observer/mesh', outputs_profile(10))

    def next(self) -> dict[int, int]:
        """Wait for a message and return its markers: id -> number of corners."""
        self._observer.spin_until(lambda: self.messages, 'markers')
        array = deserialize_message(self.messages.pop(0), MarkerArray)
        for marker in array.markers:
            assert marker.action == (Marker.ADD if marker.points else Marker.DELETE)
        return {marker.id: len(marker.points) for marker in array.markers}


def test_changed_meshes_only_and_all_for_a_newcomer(observer: Observer) -> None:
    published = MapPublishers(observer.node, Settings())
    reconstruction = Map(mesh(1), mesh(2), mesh(3))

    published.change([0, 1, 2])
    published.publish(reconstruction, 'map', 0, 1)
    assert reconstruction.asked == [], 'nobody listens'

    viewer = Viewer(observer)
    publish_until_heard(published, reconstruction, observer, viewer)
    assert viewer.next() == {0: 3, 1: 6, 2: 9}

    reconstruction.asked.clear()
    published.publish(reconstruction, 'map', 0, 1)
    assert reconstruction.asked == [], 'nothing changed'

    reconstruction.keyframes[1] = mesh(0)
    published.change([1])
    published.publish(reconstruction, 'map', 0, 1)
    assert viewer.next() == {1: 0}, 'an empty mesh is deleted'
    assert reconstruction.asked == [1]

    late = Viewer(observer)
    assert late.next() == {0: 3, 1: 6, 2: 9}, 'transient local keeps the last messages'
    assert late.next() == {1: 0}
    publish_until_heard(published, reconstruction, observer, late)
    assert late.next() == {0: 3, 1: 0, 2: 9}


def publish_until_heard(
    published: MapPublishers, reconstruction: Map, observer: Observer, viewer: Viewer
) -> None:
    def heard() -> bool:
        published.publish(reconstruction, 'map', 0, 1)
        return bool(viewer.messages)

    observer.spin_until(heard, 'the publisher to see the subscriber')


def test_large_maps_go_in_parts(observer: Observer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, '_MAX_CORNERS', 10)
    published = MapPublishers(observer.node, Settings())
    reconstruction = Map(mesh(3), mesh(3), mesh(3))
    viewer = Viewer(observer)
    publish_until_heard(published, reconstruction, observer, viewer)
    assert viewer.next() == {0: 9, 1: 9}
    published.publish(reconstruction, 'map', 0, 1)
    assert viewer.next() == {2: 9}


def test_colours_follow_the_scale(observer: Observer) -> None:
    """A change that one would see sends all meshes again."""
    published = MapPublishers(observer.node, Settings())
    reconstruction = Map(mesh(1), mesh(2))
    viewer = Viewer(observer)
    publish_until_heard(published, reconstruction, observer, viewer)
    viewer.next()
    reconstruction.scale = 0.55  # of two views: of all kernels a little more than before
    published.change([0])
    published.publish(reconstruction, 'map', 0, 2)
    assert viewer.next() == {0: 3}
    reconstruction.scale = 1.1
    published.change([0])
    published.publish(reconstruction, 'map', 0, 2)
    assert viewer.next() == {0: 3, 1: 6}
    reconstruction.by, reconstruction.scale = 'sigma', 2.2  # as much: it is no share of the views
    published.change([0])
    published.publish(reconstruction, 'map', 0, 4)
    assert viewer.next() == {0: 3}


def test_keyframes_own_meshes_can_be_left_out(observer: Observer) -> None:
    """Then there are no such topics, and the rest works."""
    published = MapPublishers(observer.node, Settings(publish_views=False))
    names = {name for name, _ in observer.node.get_publisher_names_and_types_by_node(
        'observer', '/')}
    assert not {'/observer/mesh', '/observer/edges'} & names
    assert {'/observer/points', '/observer/fused_mesh'} <= names
    published.change([0])
    assert not published.publish(Map(mesh(1)), 'map', 0, 1)
    published.clear('map')


def test_edges_for_who_wants_them(observer: Observer) -> None:
    """Each line is an edge, in its likelihood's colour; they are deleted with the map."""
    published = MapPublishers(observer.node, Settings())
    strip = replace(
        mesh(2), edges=np.array([[0, 1], [2, 3]], np.int32),
        edge_likelihood=np.array([0.2, 1.0], np.float32))
    messages = observer.collect(MarkerArray, 'observer/edges', outputs_profile(10))

    def heard() -> bool:
        published.publish(Map(strip), 'map', 0, 1)
        return bool(messages)

    observer.spin_until(heard, 'edges')
    marker, = deserialize_message(messages[-1], MarkerArray).markers
    assert (marker.type, marker.ns, marker.header.frame_id) == (Marker.LINE_LIST, 'edges', 'map')
    np.testing.assert_array_equal(
        [(point.x, point.y, point.z) for point in marker.points], strip.vertices[[0, 1, 2, 3]])
    expected = np.repeat(colours(strip.edge_likelihood, 1.0, 'turbo'), 2, axis=0) / 255
    np.testing.assert_allclose([(c.r, c.g, c.b) for c in marker.colors], expected, atol=1e-6)
    assert 0 < marker.scale.x < 1
    published.clear('map')
    observer.spin_until(
        lambda: deserialize_message(messages[-1], MarkerArray).markers[0].action
        == Marker.DELETEALL, 'the deletion')


def test_shading_shows_the_shape_and_can_be_left_out() -> None:
    """A face towards the light keeps its colour, one that looks away is darker."""
    strip = mesh(1)
    towards = triangles(0, strip, LIKELIHOOD, shading=True).colours.astype(int)
    away = replace(strip, faces=np.ascontiguousarray(strip.faces[:, ::-1]))
    dark = triangles(0, away, LIKELIHOOD, shading=True).colours.astype(int)
    pure = triangles(0, strip, LIKELIHOOD, shading=False).colours
    np.testing.assert_array_equal(pure, colours(strip.vertex_likelihood, 1.0, 'turbo'))
    bright, less = sorted((towards.sum(), dark.sum()), reverse=True)
    assert pure.astype(int).sum() >= bright > 1.4 * less > 0
    flat = replace(strip, vertices=np.zeros_like(strip.vertices))
    assert len(triangles(0, flat, LIKELIHOOD, shading=True).colours) == 3


def test_a_cloud_as_viewers_read_it() -> None:
    """Likelihoods of all keyframes are those of now, however old their clouds are."""
    old, new = cloud(mesh(2, 0.8), views=1), cloud(mesh(2, 0.5), views=2)
    message = point_cloud([old, new], 2, Colouring('likelihood', 0.5, 'turbo'))
    assert [(field.name, field.offset, field.datatype) for field in message.fields] == [
        (name, 4 * i, 7) for i, name in enumerate(
            ('x', 'y', 'z', 'rgb', 'likelihood', 'sigma', 'confidence'))]
    points = np.frombuffer(message.data, np.float32).reshape(message.width, -1)
    np.testing.assert_array_equal(points[:4, :3], mesh(2).vertices)
    np.testing.assert_allclose(points[:, 4], [0.4] * 4 + [0.5] * 4)
    rgb = np.frombuffer(message.data, np.uint8).reshape(message.width, -1)[:, 14:11:-1]
    np.testing.assert_array_equal(rgb, colours(points[:, 4], 0.5, 'turbo'))
    assert message.row_step == len(message.data)


def test_deviations_as_colours() -> None:
    """Vertices, edges and points; the sure ones in the colour of a high likelihood."""
    by_sigma = Colouring('sigma', 2e-3, 'jet')
    strip = replace(
        mesh(1), vertex_sigma=np.float32([0, 1e-3, np.inf]),
        edges=np.array([[0, 1], [1, 2]], np.int32), edge_likelihood=np.ones(2, np.float32))
    expected = colours([1.0, 0.5, 0.0], 1.0, 'jet')
    np.testing.assert_array_equal(triangles(0, strip, by_sigma, shading=False).colours, expected)
    np.testing.assert_array_equal(
        lines(0, strip, by_sigma).colours, colours([0.75, 0.75, 0.0, 0.0], 1.0, 'jet'))
    message = point_cloud([cloud(strip, 1)], 1, by_sigma)
    rgb = np.frombuffer(message.data, np.uint8).reshape(message.width, -1)[:, 14:11:-1]
    np.testing.assert_array_equal(rgb, expected)


def test_too_many_points_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('gr2t_ros.ros.publishers.MAX_POINTS', 10)
    message = point_cloud([cloud(mesh(23), 1)], 1, LIKELIHOOD)
    assert message.width == 9
    assert isinstance(message, PointCloud2)
