# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Blocks are found again wherever they lie, and the spline goes on across their borders."""
import numpy as np
import pytest

from gr2t_ros.core import blocks as lattice
from gr2t_ros.core.blocks import Blocks, find, key_of, new_blocks, place_of, VOXELS, with_keys
from gr2t_ros.core.voxel_query import jets, Lattice


def keys_of(places):
    return np.array([key_of(*place) for place in places], np.int64)


def number_of(blocks: Blocks, place) -> int:
    return int(find(blocks.table_key, blocks.table_block, key_of(*place)))


def test_keys_are_their_places():
    rng = np.random.default_rng(0)
    places = rng.integers(-2 ** 20, 2 ** 20, (500, 3))
    places = np.concatenate([places, [[-2 ** 20] * 3, [2 ** 20 - 1] * 3, [0, -1, 0]]])
    keys = keys_of(places)
    assert (keys >= 0).all() and len(np.unique(keys)) == len(np.unique(places, axis=0))
    np.testing.assert_array_equal([place_of(key) for key in keys], places)


def test_thousands_of_blocks_are_found_again_after_growing():
    rng = np.random.default_rng(1)
    places = np.unique(np.concatenate([
        rng.integers(-12, 12, (4000, 3)), rng.integers(-10 ** 6, 10 ** 6, (2000, 3))]), axis=0)
    rng.shuffle(places)
    blocks = new_blocks(64)
    seen = {}
    for change, part in enumerate(np.array_split(places, 7), 1):
        twice = np.concatenate([part, part[::2]])
        blocks, found = with_keys(blocks, keys_of(twice), change)
        assert len(found) == len(part) and found.min() > 0
        blocks.value[found.astype(np.int64) * VOXELS] = part[:, 0]
        seen.update(zip(map(tuple, part.tolist()), found.tolist()))
    assert blocks.size == len(places) + 1 and len(blocks.key) >= blocks.size
    assert sorted(seen.values()) == list(range(1, blocks.size))
    for place, number in seen.items():
        assert number_of(blocks, place) == number
        assert blocks.value[number * VOXELS] == place[0]
    assert number_of(blocks, (13, 13, 13)) == 0
    again, found = with_keys(blocks, keys_of(places), 99)
    assert again.size == blocks.size
    np.testing.assert_array_equal(found, [seen[tuple(p)] for p in places.tolist()])


def test_neighbours_are_the_blocks_beside():
    rng = np.random.default_rng(2)
    places = np.unique(rng.integers(-4, 4, (250, 3)), axis=0)
    rng.shuffle(places)
    blocks, found = with_keys(new_blocks(8), keys_of(places), 1)
    for place, block in zip(places, found):
        for n in range(27):
            beside = place + np.array([n % 3 - 1, n // 3 % 3 - 1, n // 9 - 1])
            assert blocks.neighbour[block, n] == number_of(blocks, beside)
    changed = found[:5]
    chosen = lattice.with_neighbours(blocks, changed, 2)
    assert set(chosen) == set(blocks.neighbour[changed].ravel()) - {0}
    assert len(chosen) == len(set(chosen)) and (blocks.filtered[chosen] == 2).all()


def test_block_0_stays_empty():
    blocks, found = with_keys(new_blocks(8), keys_of(np.argwhere(np.ones((4, 4, 4))) - 2), 1)
    blocks.value[VOXELS:] = 1.0
    lattice.prefilter(blocks, found)
    lattice.copy_margins(blocks, found)
    assert not blocks.value[:VOXELS].any() and not blocks.neighbour[0].any()
    assert not blocks.coefficient[:lattice.COEFFICIENTS].any()


@pytest.mark.parametrize('width', [1.2, 1.8])
def test_the_spline_follows_a_smooth_function_across_borders(width):
    """A Gaussian of width voxels about a corner where eight blocks meet."""
    places = np.argwhere(np.ones((4, 4, 4))) - 2
    rng = np.random.default_rng(3)
    rng.shuffle(places)
    blocks, found = with_keys(new_blocks(16), keys_of(places), 1)
    centre = np.array([0.3, -0.4, 0.2])
    z, y, x = np.mgrid[:8, :8, :8]
    for place, block in zip(places, found):
        voxels = 8 * place + np.stack([x, y, z], axis=-1)
        r2 = np.sum((voxels - centre) ** 2, axis=-1)
        blocks.value[block * VOXELS:(block + 1) * VOXELS] = np.exp(-r2.ravel() / 2 / width ** 2)
    lattice.prefilter(blocks, found)
    lattice.copy_margins(blocks, found)
    points = rng.uniform(-3, 3, (400, 3))
    direction = np.array([[0.4, -0.5, 0.768]])
    out = np.zeros((len(points), 3))
    jets(Lattice(blocks, 1.0), points, direction, np.zeros(1), out)
    value = np.exp(-np.sum((points - centre) ** 2, axis=1) / 2 / width ** 2)
    along = -(points - centre) @ direction[0] / width ** 2
    assert np.abs(out[:, 0] - value).max() < 0.03
    assert np.abs(out[:, 1] - value * along).max() < 0.08 / width
    second = value * (along ** 2 - direction[0] @ direction[0] / width ** 2)
    assert np.abs(out[:, 2] - second).max() < 0.3 / width ** 2
    # a border is no place of its own: one-sided values agree
    for axis in range(3):
        at = points.copy()
        at[:, axis] = 0
        below, above = np.zeros((2, len(at), 3))
        step = 1e-6 * np.eye(3)[axis]
        jets(Lattice(blocks, 1.0), at - step, direction, np.zeros(1), below)
        jets(Lattice(blocks, 1.0), at + step, direction, np.zeros(1), above)
        np.testing.assert_allclose(below[:, 0], above[:, 0], atol=1e-5)
        np.testing.assert_allclose(below[:, 1], above[:, 1], atol=0.05)
