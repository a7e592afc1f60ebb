# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The fused mesh, what it lacks and the next views, as a subscriber has them."""
from collections.abc import Iterator

import numpy as np
import pytest
from scenes_for_tests import looking_at_origin, sphere_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.next_views import where_next
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.warm_up import warm_up
from gr2t_ros.settings import Settings

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from geometry_msgs.msg import PoseArray
from rclpy.serialization import deserialize_message
from rclpy.time import Time
from ros_for_tests import Observer
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from gr2t_ros.ros import fused, outputs
from gr2t_ros.ros.fused import FusedPublishers
from gr2t_ros.ros.outputs import outputs_profile
from gr2t_ros.ros.timings import Timings

SETTINGS = Settings(
    depth_bandwidth=0.003, depth_bandwidth_quadratic=0.0, voxel_size=0.006,
    keyframe_translation=0.0, min_confidence=0.0)
CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
RADIUS = 0.2


def view_from(direction: tuple[float, float, float]) -> View:
    """Return a view of a ball about the origin."""
    return sphere_view(CAMERA, looking_at_origin(direction, 0.6), RADIUS)


@pytest.fixture(scope='module', autouse=True)
def _compiled() -> None:
    warm_up(SETTINGS)


@pytest.fixture
def ball() -> Iterator[Reconstruction]:
    """Return a map of a ball seen from one side."""
    reconstruction = Reconstruction(SETTINGS)
    for direction in ((1, 0.2, 0.1), (1, -0.3, 0.3)):
        reconstruction.add(view_from(direction))
    reconstruction.finish()
    yield reconstruction
    reconstruction.close()


class Viewer:
    """A subscriber of ~/fused_mesh and the triangles that it shows."""

    def __init__(self, observer: Observer) -> None:
        self._observer = observer
        self.messages = observer.collect(
            MarkerArray, 'observer/fused_mesh', outputs_profile(20))
        self.shown: dict[int, Marker] = {}

    def take(self) -> dict[int, int]:
        """Wait for messages; return the actions on each marker."""
        self._observer.spin_until(lambda: self.messages, 'markers')
        actions: dict[int, int] = {}
        while self.messages:
            for marker in deserialize_message(self.messages.pop(0), MarkerArray).markers:
                actions[marker.id] = marker.action
                if marker.action == Marker.DELETEALL:
                    self.shown.clear()
                elif marker.action == Marker.DELETE:
                    self.shown.pop(marker.id, None)
                else:
                    assert (marker.type, marker.ns) == (Marker.TRIANGLE_LIST, 'fused_mesh')
                    assert marker.header.frame_id == 'map'
                    self.shown[marker.id] = marker
        return actions

    def corners(self) -> set[tuple[float, ...]]:
        """Return all triangles, as the places of their corners."""
        points = [(p.x, p.y, p.z) for marker in self.shown.values() for p in marker.points]
        return {sum(points[n:n + 3], ()) for n in range(0, len(points), 3)}


def expected(reconstruction: Reconstruction) -> set[tuple[float, ...]]:
    """Return the triangles of the whole mesh."""
    mesh = reconstruction.fused_mesh(min_component=0)
    return {tuple(corners.reshape(-1)) for corners in mesh.vertices[mesh.faces]}


def publish_until(
    publishers: FusedPublishers, reconstruction: Reconstruction, observer: Observer,
    messages: list[bytes],
) -> None:
    """Publish until something has come."""
    def heard() -> bool:
        publishers.publish(reconstruction, 'map', 5, len(reconstruction.keyframes))
        return bool(messages)
    observer.spin_until(heard, 'the publisher to see the subscriber')


def test_the_mesh_as_regions_of_which_the_changed_ones_are_sent_again(
    observer: Observer, ball: Reconstruction
) -> None:
    timings = Timings()
    publishers = FusedPublishers(observer.node, SETTINGS, timings)
    assert not publishers.publish(ball, 'map', 5, 2)
    assert timings.total('fuse') == 0 and ball.fused_regions == [], 'nobody listens'

    viewer = Viewer(observer)
    publish_until(publishers, ball, observer, viewer.messages)
    viewer.take()
    assert len(viewer.shown) > 2
    whole = expected(ball)
    # parts of fewer than 50 triangles within one region are left out
    assert viewer.corners() <= whole and len(viewer.corners()) > 0.98 * len(whole)
    assert not publishers.publish(ball, 'map', 5, 2), 'nothing changed'

    before = set(viewer.shown)
    ball.add(view_from((0.3, 1, 0)))
    ball.finish()
    assert publishers.publish(ball, 'map', 5, 3)
    changed = viewer.take()
    assert set(viewer.shown) > before, 'new regions have new markers'
    assert len(viewer.corners() ^ expected(ball)) < 0.02 * len(viewer.corners())
    assert Marker.DELETE not in changed.values()

    late = Viewer(observer)
    publish_until(publishers, ball, observer, late.messages)
    observer.spin_until(
        lambda: late.take() and late.shown.keys() == viewer.shown.keys(), 'all regions')
    assert late.corners() == viewer.corners()

    publishers.clear('map')
    observer.spin_until(lambda: viewer.take() and not viewer.shown, 'the deletion')


def test_a_region_that_became_empty_is_taken_back(
    observer: Observer, ball: Reconstruction
) -> None:
    """Here since less confidence is no longer enough; the rest is sent anew."""
    publishers = FusedPublishers(observer.node, SETTINGS, Timings())
    viewer = Viewer(observer)
    publish_until(publishers, ball, observer, viewer.messages)
    viewer.take()
    before = len(viewer.shown)
    ball.settings = SETTINGS.updated({'min_confidence': 0.99})
    publishers.update(ball.settings)
    assert publishers.publish(ball, 'map', 5, 2)
    actions = viewer.take()
    assert list(actions.values()).count(Marker.DELETE) == before - len(viewer.shown) > 0


def test_large_maps_go_in_parts_and_other_colours_to_all(
    observer: Observer, ball: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    publishers = FusedPublishers(observer.node, SETTINGS, Timings())
    viewer = Viewer(observer)
    monkeypatch.setattr(outputs, '_MAX_CORNERS', 1)
    publish_until(publishers, ball, observer, viewer.messages)
    observer.spin_until(lambda: not publishers.publish(ball, 'map', 5, 2), 'the rest')
    monkeypatch.undo()
    observer.spin_until(
        lambda: viewer.messages and viewer.take() is not None and len(
            viewer.corners()) > 0.98 * len(expected(ball)), 'all parts')
    plain = dict(viewer.shown)

    ball.settings = SETTINGS.updated({'color_by': 'sigma'})
    publishers.update(ball.settings)
    publishers.publish(ball, 'map', 5, 2)
    viewer.take()
    assert viewer.shown.keys() == plain.keys()
    for number, marker in viewer.shown.items():
        assert marker.points == plain[number].points and marker.colors != plain[number].colors


def test_next_views_for_who_listens(
    observer: Observer, ball: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses look along their z axis; a search is followed by a rest; clearing empties both."""
    publishers = FusedPublishers(observer.node, SETTINGS, Timings())
    poses = observer.collect(PoseArray, 'observer/next_views', outputs_profile(10))
    clouds = observer.collect(PointCloud2, 'observer/attention', outputs_profile(10))
    publish_until(publishers, ball, observer, poses)
    observer.spin_until(lambda: clouds, 'the places')
    found = where_next(ball, ball.fused_mesh())
    array = deserialize_message(poses[-1], PoseArray)
    assert array.header.frame_id == 'map' and Time.from_msg(array.header.stamp).nanoseconds == 5
    assert len(array.poses) == len(found.views) > 0
    for pose, view in zip(array.poses, found.views):
        q = pose.orientation
        forward = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([0, 0, 1])
        np.testing.assert_allclose(forward, view.T_world_camera[:3, 2], atol=1e-6)
        place = np.array([pose.position.x, pose.position.y, pose.position.z])
        np.testing.assert_allclose(place, view.T_world_camera[:3, 3])
        assert place @ forward < 0, 'it looks at the ball'
    cloud = deserialize_message(clouds[-1], PointCloud2)
    assert [field.name for field in cloud.fields] == ['x', 'y', 'z', 'confidence']
    rows = np.frombuffer(cloud.data, np.float32).reshape(cloud.width, 4)
    np.testing.assert_allclose(rows[:, :3], found.points, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(rows[:, 3], found.confidence)

    assert not publishers.publish(ball, 'map', 6, 2), 'nothing changed'
    monkeypatch.setattr(fused, '_REST', 1e9)
    publishers._search_at = 0.0  # the rest is over
    ball.add(view_from((0.3, 1, 0)))
    assert publishers.publish(ball, 'map', 7, 3)
    ball.add(view_from((0.3, -1, 0)))
    assert not publishers.publish(ball, 'map', 8, 4), 'it rests'

    count = len(poses)
    publishers.clear('map')
    observer.spin_until(
        lambda: len(poses) > count and not deserialize_message(poses[-1], PoseArray).poses
        and deserialize_message(clouds[-1], PointCloud2).width == 0, 'empty ones')
