# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Distances are exact, and the measures are those that docs/simulation.md defines."""
import json
from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
import pytest
import trimesh

from gr2t_ros.core.colour import Colouring
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.errors import InputError
from gr2t_ros.io import ply
from gr2t_ros.tools import cli
from gr2t_ros.tools.distance import Surface
from gr2t_ros.tools.evaluate import confidence_curve, evaluate, nause
from gr2t_ros.tools.scenes import tabletop
from gr2t_ros.tools.simulate import load_mesh


def _ball(radius=0.1, subdivisions=4):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def test_distances_to_a_box_are_those_of_its_formula():
    half = np.array([0.3, 0.2, 0.1])
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (2000, 3))
    q = np.abs(points) - half
    outside = np.linalg.norm(np.maximum(q, 0), axis=1)
    expected = np.abs(outside + np.minimum(q.max(axis=1), 0))
    found = Surface(trimesh.creation.box(2 * half).triangles).distances(points)
    assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize('scale', [1e-4, 1.0, 1e4])
def test_distances_equal_a_second_library_at_every_scale(scale):
    rng = np.random.default_rng(1)
    # small and very large, thin and degenerate triangles side by side
    triangles = rng.normal(size=(300, 1, 3)) + rng.normal(size=(300, 3, 3)) * (
        10.0 ** rng.uniform(-3, 0.5, (300, 1, 1)))
    triangles[:20, 2] = triangles[:20, 1]
    triangles[20:30, 1:] = triangles[20:30, :1]
    points = np.concatenate([
        rng.normal(size=(100, 3)) * 2, triangles[:50, 0], triangles[50:100].mean(axis=1),
        100 * rng.normal(size=(10, 3))])
    expected = [
        np.linalg.norm(trimesh.triangles.closest_point(
            triangles, np.broadcast_to(point, (300, 3))) - point, axis=1).min()
        for point in points]
    found = Surface(scale * triangles).distances(scale * points) / scale
    assert_allclose(found, expected, atol=1e-9)


def test_a_surface_of_one_triangle_and_no_points():
    surface = Surface([[(0, 0, 0), (1, 0, 0), (0, 1, 0)]])
    assert_allclose(surface.distances([(0.2, 0.2, -0.5), (2, 0, 0)]), [0.5, 1.0])
    assert len(surface.distances(np.zeros((0, 3)))) == 0


def test_a_mesh_is_at_no_distance_from_itself():
    result = evaluate(_ball(), _ball())
    assert result.max_m < 1e-15
    assert [(row.precision, row.completeness, row.f_score) for row in result.thresholds] == [
        (1.0, 1.0, 1.0)] * 2
    assert result.confidence_curve == ()


def test_a_ball_half_a_millimetre_larger_is_half_a_millimetre_away():
    result = evaluate(_ball(0.1005, 5), _ball(0.1, 5), thresholds=(0.0004, 0.001))
    for value in (result.mean_m, result.median_m, result.p95_m, result.max_m):
        assert value == pytest.approx(0.0005, rel=0.1)
    assert [row.f_score for row in result.thresholds] == [0.0, 1.0]


def test_half_of_a_surface_is_half_complete_though_accurate():
    half = _ball()
    half.update_faces(half.triangles_center[:, 2] > 0)
    half.remove_unreferenced_vertices()
    row = evaluate(half, _ball()).thresholds[0]
    assert row.precision == 1.0
    assert row.completeness == pytest.approx(0.5, abs=0.02)
    assert row.f_score == pytest.approx(2 * 0.5 / 1.5, abs=0.02)


def test_figures_are_the_same_each_time():
    assert evaluate(_ball(0.1004), _ball()) == evaluate(_ball(0.1004), _ball())


def test_the_confidence_curve_falls_where_likelihood_tells_errors():
    error = np.linspace(0.0, 0.01, 1000)
    curve = confidence_curve(error, -error)
    assert [point.share for point in curve] == pytest.approx(np.arange(1, 11) / 10)
    assert curve[0].mean_m == pytest.approx(0.0005, rel=0.01)
    assert curve[-1].mean_m == pytest.approx(0.005)
    assert np.all(np.diff([point.mean_m for point in curve]) > 0)
    nothing_known = confidence_curve(error, np.full(1000, np.nan))
    assert nothing_known[-1].mean_m == pytest.approx(0.005)


def test_nause_is_0_for_the_true_order_and_about_1_for_a_random_one():
    rng = np.random.default_rng(0)
    error = rng.exponential(1.0, 20_000)
    assert nause(error, -error) == pytest.approx(0.0, abs=1e-12)
    assert nause(error, rng.random(20_000)) == pytest.approx(1.0, abs=0.05)
    assert nause(error, error) > 1.5
    assert nause(np.ones(10), np.arange(10)) == 0.0  # nothing to order
    unknown = np.where(error > np.median(error), np.nan, 1.0)
    assert nause(error, unknown) < 0.5


def test_the_command_prints_what_the_file_s_likelihoods_tell(tmp_path, capsys):
    ball = _ball()
    noise = np.random.default_rng(0).normal(0, 0.0005, len(ball.vertices))
    vertices = ball.vertices * (1 + noise[:, None] / 0.1)
    mesh = ViewMesh(
        vertices=vertices, vertex_likelihood=np.exp(-np.abs(noise) * 1e3).astype(np.float32),
        vertex_sigma=np.ones(len(noise), np.float32),
        vertex_confidence=np.ones(len(noise), np.float32),
        faces=ball.faces.astype(np.int32), edges=ball.edges_unique.astype(np.int32),
        edge_likelihood=np.ones(len(ball.edges_unique), np.float32))
    colouring = Colouring('likelihood', 1.0, 'turbo')
    ply.write_view(tmp_path / 'mesh.ply', 0, mesh, colouring)
    ball.export(tmp_path / 'truth.stl')
    likelihood = load_mesh(tmp_path / 'mesh.ply').vertex_attributes['likelihood']
    assert len(likelihood) == len(ball.vertices)
    files = [str(tmp_path / 'mesh.ply'), str(tmp_path / 'truth.stl')]
    assert cli.main(['evaluate', *files, '--json', '--threshold', '0.001']) == 0
    result = json.loads(capsys.readouterr().out)
    assert result['vertices'] == len(ball.vertices)
    assert result['mean_m'] == pytest.approx(0.0005 * np.sqrt(2 / np.pi), rel=0.1)
    assert [row['threshold_m'] for row in result['thresholds']] == [0.001]
    curve = [point['mean_m'] for point in result['confidence_curve']]
    assert len(curve) == 10 and curve[0] < 0.2 * curve[-1]
    assert cli.main(['evaluate', *files]) == 0
    text = capsys.readouterr().out
    assert '(mm)' in text and 'completeness %' in text and 'most likely' in text


def test_a_folder_does_not_hide_the_built_in_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'tabletop').mkdir()  # such as the recording of it
    assert len(load_mesh(Path('tabletop')).faces) == len(tabletop().faces)


def test_a_mesh_without_likelihoods_has_no_confidence_curve(tmp_path, capsys):
    for name in ('a.obj', 'b.stl'):
        _ball(subdivisions=2).export(tmp_path / name)
    assert cli.main(['evaluate', str(tmp_path / 'a.obj'), str(tmp_path / 'b.stl')]) == 0
    assert 'most likely' not in capsys.readouterr().out


def test_a_built_in_scene_may_be_the_reference(tmp_path, capsys):
    scene = tabletop()
    scene.export(tmp_path / 'scene.ply')
    assert cli.main(['evaluate', str(tmp_path / 'scene.ply'), 'tabletop', '--json']) == 0
    assert json.loads(capsys.readouterr().out)['max_m'] < 1e-7  # the file has float32


def test_meshes_in_different_units_are_refused():
    millimetres = _ball()
    millimetres.apply_scale(1000)
    with pytest.raises(InputError, match='metres'):
        evaluate(millimetres, _ball())


@pytest.mark.parametrize('arguments', [
    ['nothing.ply', 'ball.ply'], ['ball.ply', 'nothing.ply'], ['ball.ply', 'text.obj'],
    ['ball.ply', 'ball.ply', '--threshold', '0']])
def test_a_call_that_cannot_be_used_is_one_line_and_exit_code_2(
    arguments, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    _ball(subdivisions=1).export('ball.ply')
    (tmp_path / 'text.obj').write_text('not a mesh')
    assert cli.main(['evaluate', *arguments]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
