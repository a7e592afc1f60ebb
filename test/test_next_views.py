# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The suggested views look at what a scan has left out."""
from collections.abc import Sequence

import numpy as np
import pytest
from scenes_for_tests import looking_at_origin, plane_view, sphere_view
from test_seen_space import image
import trimesh

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.next_views import Attention, attention, where_next
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.settings import Settings

CAMERA = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
RADIUS, DISTANCE = 0.2, 0.7
HALF = [(np.cos(a), np.sin(a), z) for a in np.radians((-80, -40, 0, 40, 80)) for z in (-0.5, 0.5)]
ALL = [*HALF, *((-x, y, z) for x, y, z in HALF), (0.1, 0, 1), (0.1, 0, -1)]
BALL = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)


def ball_views(directions: Sequence[Sequence[float]]) -> list[View]:
    """Return views of a ball about the origin."""
    return [sphere_view(CAMERA, looking_at_origin(d, DISTANCE), RADIUS) for d in directions]


def suggested(views: Sequence[View], confidence: np.ndarray | None = None) -> Attention:
    """Return what is missing of the ball that the views see, to half a degree."""
    seen = np.zeros(len(BALL.faces), bool)
    for view in views:
        ways = view.T_world_camera[:3, 3] - BALL.triangles_center
        cosines = np.sum(ways * BALL.face_normals, axis=1) / np.linalg.norm(ways, axis=1)
        seen |= cosines > 0.05
    if confidence is None:
        confidence = np.ones(len(BALL.vertices))
    return attention(
        np.array(BALL.vertices), BALL.faces[seen].astype(np.int32),
        confidence.astype(np.float32), [image(view) for view in views], depth_min=0.1)


def angle(one: np.ndarray, other: Sequence[float]) -> float:
    """Return the angle between directions, degrees."""
    cosine = one @ other / np.linalg.norm(one) / np.linalg.norm(other)
    return float(np.degrees(np.arccos(cosine)))


def test_the_side_that_nobody_saw() -> None:
    """The first view is on that side, looks at the thing, and stands within range."""
    views = ball_views(HALF)
    found = suggested(views)
    first = found.views[0]
    eye, forward = first.T_world_camera[:3, 3], first.T_world_camera[:3, 2]
    assert angle(eye, (-1, 0, 0)) < 40
    assert angle(forward, -eye) < 30
    assert 0.3 < np.linalg.norm(eye) < 1.2
    assert first.T_world_camera[2, 1] * views[0].T_world_camera[2, 1] > 0, 'as they were held'
    np.testing.assert_allclose(
        first.T_world_camera[:3, :3] @ first.T_world_camera[:3, :3].T, np.eye(3), atol=1e-9)
    assert abs(np.linalg.norm(first.position) - RADIUS) < 0.03 and first.position[0] < 0.03
    assert 0.001 < first.area < 4 * np.pi * RADIUS ** 2
    # it is where the surface ends, in a ring
    assert len(found.points) > 100 and (found.confidence == 0).all()
    assert found.points[:, 0].max() < 0
    radii = np.linalg.norm(found.points, axis=1)
    assert radii.min() > 0.7 * RADIUS and radii.max() < 1.3 * RADIUS


def test_nothing_is_missing_of_a_whole() -> None:
    found = suggested(ball_views(ALL))
    assert found.views == () and len(found.points) == 0


def test_each_view_shows_what_those_before_it_do_not() -> None:
    """Of two sides left out each gets a view."""
    belt = [(np.cos(a), np.sin(a), 0.0) for a in np.radians(range(0, 360, 30))]
    first, second = suggested(ball_views(belt)).views[:2]
    heights = sorted(view.T_world_camera[2, 3] for view in (first, second))
    assert heights[0] < -0.3 and heights[1] > 0.3


def test_doubtful_surface_is_looked_at_again() -> None:
    """From the side that it faces; a sure one is left alone."""
    confidence = np.where(BALL.vertices[:, 1] > 0.8 * RADIUS, 0.3, 0.9)
    found = suggested(ball_views(ALL), confidence)
    assert angle(found.views[0].T_world_camera[:3, 3], (0, 1, 0)) < 40
    assert (found.points[:, 1] > 0.75 * RADIUS).all()
    assert found.confidence.min() > 0.29 and found.confidence.max() < 0.5
    cap = 2 * np.pi * RADIUS ** 2 * 0.2
    assert 0.6 * cap < found.views[0].area < 1.4 * cap


def test_a_wall_that_goes_on_beyond_the_images() -> None:
    """Views stand before it, where the cameras were, and look at where it ends."""
    poses = [looking_at_origin((x, y, 1), 0.8) for x in (-0.2, 0.2) for y in (-0.1, 0.1)]
    views = [plane_view(CAMERA, pose, (0, 0, 1), 0.0) for pose in poses]
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 81), np.linspace(-0.3, 0.3, 61))
    wall = trimesh.Trimesh(
        np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]),
        np.concatenate([
            [(i, i + 1, i + 82), (i, i + 82, i + 81)]
            for i in range(60 * 81) if i % 81 < 80]))
    found = attention(
        np.array(wall.vertices), wall.faces.astype(np.int32),
        np.ones(len(wall.vertices), np.float32), [image(view) for view in views], depth_min=0.1)
    assert found.views
    for view in found.views:
        assert view.T_world_camera[2, 3] > 0.05
        assert max(abs(view.position[0]) / 0.4, abs(view.position[1]) / 0.3) > 0.8


@pytest.mark.parametrize('views', [[], ball_views([(1, 0, 0.1)])])
def test_of_nothing_nothing_is_suggested(views: list[View]) -> None:
    found = attention(
        np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, np.float32),
        [image(view) for view in views], 0.1)
    assert found.views == () and len(found.points) == len(found.confidence) == 0


def test_a_map_says_where_to_go_next() -> None:
    reconstruction = Reconstruction(Settings(
        depth_bandwidth=0.003, depth_bandwidth_quadratic=0.0, voxel_size=0.006,
        keyframe_translation=0.0))
    assert where_next(reconstruction, reconstruction.fused_mesh()).views == ()
    for view in ball_views(HALF):
        reconstruction.add(view)
    reconstruction.finish()
    found = where_next(reconstruction, reconstruction.fused_mesh())
    again = where_next(reconstruction, reconstruction.fused_mesh())
    assert len(where_next(reconstruction, reconstruction.fused_mesh(), count=1).views) == 1
    reconstruction.close()
    assert angle(found.views[0].T_world_camera[:3, 3], (-1, 0, 0)) < 60
    np.testing.assert_array_equal(found.points, again.points)
