# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A frozen map is what it was, whatever happens to the original; and the other way round."""
import numpy as np
import pytest
from scenes_for_tests import bumpy_views

from gr2t_ros.core.frozen import room_for
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.settings import Settings

SETTINGS = Settings(
    depth_bandwidth=0.004, keyframe_translation=0.0, threads=2, voxel_size=0.005,
    remarch_budget=0.0)


def built(views, settings):
    reconstruction = Reconstruction(settings)
    for view in views:
        reconstruction.add(view)
    return reconstruction


def assert_same_meshes(ours, theirs):
    ours.finish()
    theirs.finish()
    assert len(ours.keyframes) == len(theirs.keyframes)
    for (_, a), (_, b) in zip(ours.meshes(), theirs.meshes()):
        for name in vars(a):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize('density', ['voxel', 'exact'])
@pytest.mark.parametrize('roomy', [True, False], ids=['room', 'no room'])
def test_each_goes_its_way(density, roomy):
    settings = SETTINGS.updated({'density': density})
    views = bumpy_views()
    half = len(views) // 2
    original = built(views[:half], settings)
    frozen = original.frozen(room_for(original.density) if roomy else {})
    frozen.finish()
    for view in views[half:]:
        original.add(view)
    original.finish()
    assert_same_meshes(frozen, built(views[:half], settings))
    assert_same_meshes(original, built(views, settings))
    original.close()


def test_room_is_made_before_the_map_grows():
    """What was made for a smaller map does not hold the larger one, and is not needed."""
    views = bumpy_views()
    original = built(views[:1], SETTINGS)
    room = room_for(original.density)
    for view in views[1:]:
        original.add(view)
    assert_same_meshes(original.frozen(room), built(views, SETTINGS))


def test_an_empty_map_stays_empty():
    frozen = Reconstruction(SETTINGS).frozen({})
    assert frozen.keyframes == [] and frozen.finish().waiting == 0
