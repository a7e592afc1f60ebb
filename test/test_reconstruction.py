# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The engine keeps its promises: incremental is batch, threads change nothing, bounds are said."""
from contextlib import closing

import numpy as np
import pytest
from scenes_for_tests import bumpy_views, looking_at_origin, plane_view, pose, sphere_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.errors import FrameError
from gr2t_ros.settings import Settings

SETTINGS = Settings(
    depth_bandwidth=0.004, depth_bandwidth_quadratic=0.002, keyframe_translation=0.0, threads=2,
    voxel_size=0.005)
EXACT = SETTINGS.updated({'density': 'exact'})


def run(views, settings=SETTINGS):
    reconstruction = Reconstruction(settings)
    updates = [reconstruction.add(view) for view in views]
    updates.append(reconstruction.finish())
    return reconstruction, updates


def rays_of(reconstruction):
    return [
        np.concatenate([getattr(k.rays, name).ravel() for k in reconstruction.keyframes])
        for name in ('pixels', 'depth', 'total', 'status', 'iterations')]


def orbit(count):
    camera = Camera(80, 60, 120.0, 120.0, 39.5, 29.5)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [
        sphere_view(camera, looking_at_origin([np.cos(a), np.sin(a), 0.3], 0.5), 0.12)
        for a in angles]


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
@pytest.mark.parametrize('views', [bumpy_views(), orbit(6)], ids=['distorted', 'orbit'])
def test_incremental_equals_batch(views, settings):
    incremental, updates = run(views, settings.updated({'remarch_budget': 60.0}))
    batch, late = run(views, settings.updated({'remarch_budget': 0.0}))
    for a, b in zip(rays_of(incremental), rays_of(batch)):
        np.testing.assert_array_equal(a, b)
    assert updates[-1].remarched == 0 and late[-1].remarched > 0
    assert updates[-2].waiting == 0 and late[-2].waiting >= late[-1].remarched
    for (_, a), (_, b) in zip(incremental.meshes(), batch.meshes()):
        np.testing.assert_array_equal(a.faces, b.faces)
        np.testing.assert_array_equal(a.edge_likelihood, b.edge_likelihood)


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
def test_what_appears_beside_a_surface_is_seen_by_its_rays(settings):
    """A later view fills the end of the search interval, where nothing was before."""
    camera = Camera(40, 30, 80.0, 80.0, 19.5, 14.5)
    h3 = 0.005
    views = [
        plane_view(camera, np.eye(4), [0, 0, 1], 0.5 + offset * h3) for offset in (0, 4.5, -40, 6)]
    incremental, updates = run(views, settings.updated({'remarch_budget': 60.0}))
    batch, _ = run(views, settings.updated({'remarch_budget': 0.0}))
    for a, b in zip(rays_of(incremental), rays_of(batch)):
        np.testing.assert_array_equal(a, b)
    assert updates[1].remarched == 1200 and updates[1].changed == (1, 0)
    assert updates[2].remarched == 0 and updates[2].changed == (2,)


def test_under_load_older_rays_wait_and_none_is_forgotten():
    with (closing(Reconstruction(SETTINGS.updated({'remarch_budget': 60.0}))) as busy,
          closing(Reconstruction(SETTINGS.updated({'remarch_budget': 60.0}))) as idle):
        for view in orbit(4):
            loaded, free = busy.add(view, load=1.0), idle.add(view)
            assert loaded.remarched == 0 and loaded.marched == free.marched
        assert loaded.waiting > free.waiting == 0
        busy.finish()
        for a, b in zip(rays_of(busy), rays_of(idle)):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
def test_one_thread_equals_four(settings):
    for a, b in zip(*(rays_of(run(orbit(4), settings.updated({'threads': n}))[0])
                      for n in (1, 4))):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
def test_only_affected_rays_are_marched_again(settings):
    camera = Camera(40, 30, 80.0, 80.0, 19.5, 14.5)
    here = plane_view(camera, np.eye(4), [0, 0, 1], 0.5)
    there = plane_view(camera, pose([0, 0, 0], [1, 0, 0]), [0, 0, 1], 0.5)
    beside = plane_view(camera, pose([0, 0, 0], [0.12, 0, 0]), [0, 0, 1], 0.5)
    _, (first, apart, overlap, _) = run([here, there, beside], settings)
    assert first.marched == 1200 and first.keyframe == 0 and first.changed == (0,)
    assert apart.remarched == 0 and apart.changed == (1,)
    assert 0 < overlap.remarched < 1200 and overlap.changed == (2, 0)


def test_frames_near_the_last_keyframe_add_to_the_density_only():
    settings = SETTINGS.updated({'keyframe_translation': 0.1, 'keyframe_rotation': 0.2})
    camera = Camera(40, 30, 80.0, 80.0, 19.5, 14.5)
    poses = [pose([0, 0, 0], [x, 0, 0]) for x in (0, 0.05, 0.11)]
    poses.append(pose([0, 0, 0.3], [0.1, 0, 0]))
    reconstruction, updates = run(
        [plane_view(camera, T, [0, 0, 1], 0.5) for T in poses], settings)
    assert [u.keyframe for u in updates[:-1]] == [0, None, 1, 2]
    assert updates[1].remarched > 0 and len(reconstruction.keyframes) == 3


def test_the_bound_on_keyframes_is_kept_and_said():
    reconstruction, updates = run(orbit(4), SETTINGS.updated({'max_keyframes': 2}))
    assert len(reconstruction.keyframes) == 2
    assert [any('max_keyframes' in n for n in u.notices) for u in updates[:4]] == [
        False, False, True, False]


def test_colours_have_a_scale_and_an_empty_map_has_none():
    reconstruction, _ = run(orbit(3))
    likelihoods = np.concatenate([m.vertex_likelihood for _, m in reconstruction.meshes()])
    assert likelihoods.min() < reconstruction.colouring().scale <= likelihoods.max()
    assert Reconstruction(SETTINGS).colouring().scale == 0
    sigmas = np.concatenate([m.vertex_sigma for _, m in reconstruction.meshes()])
    reconstruction.settings = SETTINGS.updated({'color_by': 'sigma', 'colour_map': 'jet'})
    colouring = reconstruction.colouring()
    assert (colouring.by, colouring.colour_map) == ('sigma', 'jet')
    assert sigmas.min() < colouring.scale <= sigmas.max()
    assert Reconstruction(reconstruction.settings).colouring().scale == 0


def test_a_depth_image_of_the_wrong_size_is_one_frame_s_error():
    view = orbit(1)[0]
    with pytest.raises(FrameError, match='60, 70') as error:
        Reconstruction(SETTINGS).add(
            View(view.depth[:, :70], view.camera, view.T_world_camera, 0))
    assert error.value.reason == 'image_size'


def test_an_image_without_any_depth_is_survived():
    view = orbit(1)[0]
    empty = View(np.full_like(view.depth, np.nan), view.camera, view.T_world_camera, 1)
    reconstruction, updates = run([empty, view])
    assert updates[0].marched == 0 and updates[1].converged > 0
    assert len(dict(reconstruction.meshes())[0].vertices) == 0
