# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A lattice without some of its blocks is the lattice that never had them."""
import numpy as np
import pytest

from gr2t_ros.core.block_removal import without
from gr2t_ros.core.blocks import (
    Blocks,
    COEFFICIENTS,
    copy_margins,
    find,
    key_of,
    new_blocks,
    place_of,
    prefilter,
    VOXELS,
    with_keys,
)

SINCE = 5


def keys_of(places: np.ndarray) -> np.ndarray:
    return np.array([key_of(*place) for place in places], np.int64)


def lattice_of(places: np.ndarray, capacity: int = 64) -> Blocks:
    """Return blocks with values that tell where they are."""
    blocks, found = with_keys(new_blocks(capacity), keys_of(places), 1)
    for place, block in zip(places, found):
        for values, each in (
                (blocks.value, VOXELS), (blocks.expected, VOXELS),
                (blocks.coefficient, COEFFICIENTS)):
            values[block * each:(block + 1) * each] = each + place @ [1, 100, 10_000]
    return blocks


def check(blocks: Blocks, places: np.ndarray) -> None:
    """Check that the lattice holds these blocks and no others."""
    assert blocks.size == len(places) + 1
    there = {tuple(place) for place in places.tolist()}
    for place in there:
        block = int(find(blocks.table_key, blocks.table_block, key_of(*place)))
        assert 0 < block < blocks.size and place_of(blocks.key[block]) == place
        for values, each in ((blocks.value, VOXELS), (blocks.expected, VOXELS)):
            expected = each + np.array(place) @ [1, 100, 10_000]
            assert (values[block * each:(block + 1) * each] == expected).all()
        for n in range(27):
            beside = (place[0] + n % 3 - 1, place[1] + n // 3 % 3 - 1, place[2] + n // 9 - 1)
            other = int(find(blocks.table_key, blocks.table_block, key_of(*beside)))
            assert blocks.neighbour[block, n] == other
            assert (other > 0) == (beside in there)
    assert not blocks.neighbour[0].any()
    for values, each in (
            (blocks.value, VOXELS), (blocks.expected, VOXELS),
            (blocks.coefficient, COEFFICIENTS)):
        assert not values[:each].any() and not values[blocks.size * each:].any()
    assert np.count_nonzero(blocks.table_block) == len(places)


@pytest.mark.parametrize('share', [0.0, 0.1, 0.5, 0.9, 1.0])
def test_what_stays_is_found_and_what_leaves_is_not(share: float) -> None:
    """A full hash, in which keys have pushed each other away."""
    rng = np.random.default_rng(0)
    places = np.unique(rng.integers(-60, 60, (3000, 3)), axis=0)
    rng.shuffle(places)
    blocks = lattice_of(places)
    stays = rng.random(len(places)) < share
    blocks.touched[1:blocks.size][stays] = SINCE + 1
    fewer, renumbered, _ = without(blocks, np.zeros(blocks.size, np.bool_), SINCE)
    check(fewer, places[stays])
    assert renumbered[0] == 0 and ((renumbered[1:] > 0) == stays).all()
    for place, number in zip(places[stays], renumbered[1:][stays]):
        assert place_of(fewer.key[number]) == tuple(place)
    again, _ = with_keys(fewer, keys_of(places[~stays]), 9)
    assert again.size == len(places) + 1
    assert not again.value[fewer.size * VOXELS:].any(), 'new blocks are empty'


def test_what_a_watched_block_s_spline_depends_on_stays() -> None:
    """Four taps reach into the next block on each axis, and coefficients one beyond."""
    places = np.argwhere(np.ones((9, 9, 9))) - 4
    blocks = lattice_of(places)
    watched = np.zeros(blocks.size, np.bool_)
    watched[find(blocks.table_key, blocks.table_block, key_of(0, 0, 0))] = True
    fewer, *_ = without(blocks, watched, SINCE)
    check(fewer, places[((places >= -1) & (places <= 2)).all(axis=1)])


def test_the_spline_is_that_of_the_blocks_that_stay() -> None:
    rng = np.random.default_rng(1)
    places = np.unique(rng.integers(-6, 6, (900, 3)), axis=0)
    rng.shuffle(places)
    stays = rng.random(len(places)) < 0.5
    lattices = []
    for chosen in (places, places[stays]):
        blocks, found = with_keys(new_blocks(16), keys_of(chosen), SINCE + 1)
        for place, block in zip(chosen, found):
            blocks.value[block * VOXELS:(block + 1) * VOXELS] = np.random.default_rng(
                place + 10).random(VOXELS, np.float32)
        prefilter(blocks, found)
        copy_margins(blocks, found)
        lattices.append(blocks)
    blocks, expected = lattices
    blocks.touched[1:blocks.size][~stays] = 0
    fewer, _, border = without(blocks, np.zeros(blocks.size, np.bool_), SINCE)
    prefilter(fewer, border)
    copy_margins(fewer, border)
    for place in places[stays]:
        ours, theirs = (
            int(find(item.table_key, item.table_block, key_of(*place))) * COEFFICIENTS
            for item in (fewer, expected))
        np.testing.assert_array_equal(
            fewer.coefficient[ours:ours + COEFFICIENTS],
            expected.coefficient[theirs:theirs + COEFFICIENTS])


def test_memory_is_given_back() -> None:
    def resident() -> int:
        with open('/proc/self/statm', encoding='ascii') as file:
            return int(file.read().split()[1]) * 4096

    side = np.arange(30)
    places = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    blocks = lattice_of(places, len(places) + 1)
    before = resident()
    fewer, *_ = without(blocks, np.zeros(blocks.size, np.bool_), SINCE)
    assert fewer.size == 1
    assert before - resident() > 0.9 * 4 * len(places) * (2 * VOXELS + COEFFICIENTS)
