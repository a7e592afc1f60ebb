# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Pictures show what is there, from a side that one wants to see."""
import numpy as np
from numpy.testing import assert_allclose
from PIL import Image
import pytest
import trimesh

from gr2t_ros.core.colour import Colouring, colours
from gr2t_ros.errors import Gr2tError
from gr2t_ros.tools.orbit import looking_at, orbit
from gr2t_ros.tools.raster import rasterise, vertex_normals
from gr2t_ros.tools.render import preview, render
from gr2t_ros.tools.viewpoint import good_view

FOCAL, WIDTH, HEIGHT = 40.0, 41, 31
RED, BLUE = (255, 0, 0), (0, 0, 255)


def _square(z, half=0.25, colour=RED):
    """Return a square that faces the camera: vertices, faces, colours."""
    x = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    points = np.column_stack([x, np.full(4, z)]).astype(np.float32)
    return points, np.int32([(0, 2, 1), (0, 3, 2)]), np.tile(np.uint8(colour), (4, 1))


def _raster(*squares):
    points = np.concatenate([square[0] for square in squares])
    faces = np.concatenate([square[1] + 4 * i for i, square in enumerate(squares)])
    shades = np.concatenate([square[2] for square in squares])
    return rasterise(points, vertex_normals(points, faces), faces, shades, FOCAL, WIDTH, HEIGHT)


def test_a_square_covers_the_pixels_that_it_projects_to():
    raster = _raster(_square(1.0))
    seen = np.zeros((HEIGHT, WIDTH), bool)
    seen[5:26, 10:31] = True  # 40 px times 0.25 m at 1 m: 10 px about the middle, (20, 15)
    assert np.array_equal(np.isfinite(raster.depth), seen)
    assert_allclose(raster.depth[seen], 1.0, rtol=1e-6)
    assert_allclose(raster.normal[seen], np.tile((0, 0, -1), (seen.sum(), 1)), atol=1e-6)
    assert_allclose(raster.colour[seen], np.tile(RED, (seen.sum(), 1)), atol=1e-3)


def test_the_nearer_surface_hides_the_farther_whatever_the_order():
    near, far = _square(1.0), _square(2.0, half=2.0, colour=BLUE)
    for raster in (_raster(near, far), _raster(far, near)):
        assert_allclose(raster.colour[15, 20], RED, atol=1e-3)
        assert_allclose(raster.colour[0, 0], BLUE, atol=1e-3)


def test_overlapping_layers_are_averaged():
    raster = _raster(_square(1.0), _square(1.0001, colour=BLUE))
    assert_allclose(raster.colour[15, 20], (127.5, 0, 127.5), atol=5)


def test_depth_is_right_across_a_slanted_triangle():
    points = np.float32([(-1, -1, 1), (1, -1, 3), (0, 2, 2)])
    faces = np.int32([(0, 1, 2)])
    raster = rasterise(
        points, vertex_normals(points, faces), faces, np.zeros((3, 3), np.uint8),
        FOCAL, WIDTH, HEIGHT)
    v, u = np.nonzero(np.isfinite(raster.depth))
    rays = np.column_stack([(u - 20) / FOCAL, (v - 15) / FOCAL, np.ones(len(u))])
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    assert len(u) > 100
    assert_allclose(raster.depth[v, u], normal @ points[0] / (rays @ normal), rtol=1e-5)


def test_both_sides_are_drawn_and_what_is_behind_the_camera_is_not():
    points, faces, shades = _square(1.0)
    turned = _raster((points, faces[:, ::-1], shades))
    assert_allclose(turned.normal[15, 20], (0, 0, -1), atol=1e-6)
    assert not np.isfinite(_raster(_square(-1.0)).depth).any()


def test_no_triangles_make_an_empty_picture():
    nothing = np.zeros((0, 3))
    picture = render(nothing, nothing, nothing.astype(np.uint8), np.eye(4), 64, 48)
    assert picture.shape == (48, 64, 3)
    assert picture.min() > 190


def test_surfaces_that_face_the_light_are_brighter_and_keep_their_hue():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    shades = np.tile(np.uint8((200, 100, 50)), (len(ball.vertices), 1))
    picture = render(
        ball.vertices, ball.faces, shades, looking_at((0.4, 0, 0), (0, 0, 0)), 160, 120)
    lit, dark = picture[45, 65].astype(float), picture[80, 100].astype(float)
    assert lit.sum() > 1.2 * dark.sum()
    for pixel in (lit, dark):
        assert_allclose(pixel / pixel[0], (1, 0.5, 0.25), atol=0.03)


def test_an_object_is_seen_whole_and_large():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.apply_translation((5, 6, 7))
    T_world_camera = good_view(
        ball.vertices, ball.faces, orbit((5, 6, 7), 0.35, 12), 1.3, 0.75)
    shades = np.tile(np.uint8((200, 0, 0)), (len(ball.vertices), 1))
    picture = render(ball.vertices, ball.faces, shades, T_world_camera, 160, 120)
    red = picture[..., 2] < 100
    assert 0.25 < red.mean() < 0.6
    assert not (red[0].any() or red[-1].any() or red[:, 0].any() or red[:, -1].any())


@pytest.mark.parametrize('yaw', [0.0, 2.0])
def test_a_room_scanned_from_inside_is_not_seen_through_the_back_of_its_walls(yaw):
    room = trimesh.creation.box((4, 4, 2.4))
    room.invert()  # its triangles face inwards
    room = room.subdivide().subdivide()
    poses = []
    for azimuth in np.arange(yaw, yaw + 2 * np.pi, 0.5):
        direction = np.array([np.cos(azimuth), np.sin(azimuth), -0.2])
        poses.append(looking_at(-0.3 * direction, direction))
    T_world_camera = good_view(room.vertices, room.faces, poses, 1.3, 0.75)
    eye = T_world_camera[:3, 3]
    assert (np.abs(eye) < (2, 2, 1.2)).all()


def test_a_wall_seen_from_one_side_is_looked_at_from_there():
    wall = trimesh.creation.box((0.01, 3, 2))
    wall.update_faces(wall.face_normals[:, 0] > 0.5)
    wall = wall.subdivide()
    poses = [looking_at((2, y, 0), (0, y, 0)) for y in (-1.0, 0.0, 1.0)]
    T_world_camera = good_view(wall.vertices, wall.faces, poses, 1.3, 0.75)
    assert T_world_camera[0, 3] > 0.5
    assert T_world_camera[2, 1] < 0  # upright


@pytest.mark.parametrize(('by', 'likelihood', 'sigma'), [
    ('likelihood', 3e-6, 0.0), ('likelihood', 3e-6, 3e-6), ('sigma', 0.0, 0.0)])
def test_the_preview_is_a_picture_with_a_scale_in_the_mesh_s_colours(
        by, likelihood, sigma, tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    preview(
        tmp_path / 'ball.png', ball.vertices, ball.faces, np.full(len(ball.vertices), likelihood),
        np.full(len(ball.vertices), sigma), Colouring(by, 3e-6, 'turbo'), title='ball',
        width=640, height=400)
    picture = np.asarray(Image.open(tmp_path / 'ball.png').convert('RGB')).astype(int)
    assert picture.shape == (476, 640, 3)
    footer = picture[400:].reshape(-1, 3)
    ramp = colours(np.linspace(0, 1, 8), 1.0, 'turbo').astype(int)
    nearest = np.abs(footer[None] - ramp[:, None]).sum(axis=-1).min(axis=1)
    assert nearest.max() < 12
    red = picture[200, 320]
    assert red[0] > 60 and red[0] > 3 * red[2]


@pytest.mark.parametrize('faces', [np.zeros((0, 3), int), np.array([(0, 1, 2)])])
def test_a_preview_of_nothing_is_still_a_picture(faces, tmp_path):
    preview(tmp_path / 'a.png', np.zeros((3, 3)), faces, np.zeros(3), np.zeros(3),
            Colouring('likelihood', 0.0, 'turbo'), width=480)
    assert Image.open(tmp_path / 'a.png').size == (480, 876)


def test_vertices_that_no_triangle_uses_do_not_change_the_picture(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    stray = np.concatenate([[(50.0, 0, 0)], ball.vertices])
    for name, vertices, faces in (
            ('a.png', ball.vertices, ball.faces), ('b.png', stray, ball.faces + 1)):
        preview(
            tmp_path / name, vertices, faces, np.ones(len(vertices)), np.ones(len(vertices)),
            Colouring('likelihood', 1.0, 'turbo'), width=480, height=120)
    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()


def test_a_preview_that_cannot_be_written_says_where(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(Gr2tError, match='file'):
        preview(
            tmp_path / 'file' / 'a.png', np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros(0),
            np.zeros(0), Colouring('likelihood', 1.0, 'turbo'), width=480, height=120)
