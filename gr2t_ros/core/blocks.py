# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sparse lattice: blocks of 8 x 8 x 8 voxels, found by a hash, with spline coefficients.

Voxel (i, j, k) of the world lies at (i, j, k) times the voxel size; block numbers and offsets are
whole, so no position is ever rounded. Block 0 is empty and stands for all that is not there.
"""
from __future__ import annotations

from collections.abc import Callable
import mmap
from typing import Any, NamedTuple, TypeVar

from numba import int64, njit, uint64
import numpy as np
from numpy.typing import NDArray

from .compiled import uncounted
from .vector import copy_eight, five_taps, ROW

Floats = NDArray[np.float32]

SIDE = 8  # voxels
VOXELS = SIDE ** 3
COEFFICIENTS = SIDE * SIDE * ROW
BYTES_PER_BLOCK = 2 * 4 * VOXELS + 4 * COEFFICIENTS + 8 + 27 * 4 + 2 * 4
NO_LIMIT = 1 << 40  # blocks
_LAST_STEP = 16
_BITS = 21  # of a block's number on each axis: 2 million blocks either way
_OFFSET = 1 << (_BITS - 1)
_MASK = (1 << _BITS) - 1
_SELF = 13  # of the 27 neighbours (z, y, x)
# five taps that turn samples into coefficients for vector.spline_jet: exact at constants, and
# fitted to values and slopes of Gaussians 1 to 2 voxels wide; the exact filter never ends
_TAP0, _TAP1, _TAP2 = np.float32(1.84459251), np.float32(-0.50952536), np.float32(0.08722910)


class Blocks(NamedTuple):
    """
    The lattice's arrays, as the kernels use them.

    :param size: number of blocks in use, block 0 included; the arrays may be longer
    :param table_key: (2^k,) int64 of the hash; table_block: (2^k,) int32, 0 where free
    :param key: (n,) int64, each block's place
    :param value: flat float32, VOXELS a block, x fastest: C times the likelihood
    :param expected: likewise: C times the peak that the views which see the voxel would give
    :param coefficient: flat float32, COEFFICIENTS a block
    :param neighbour: (n, 27) int32, 0 where there is none
    :param touched: (n,) int32, the last change of the values; filtered: of the coefficients
    """

    size: int
    table_key: NDArray[np.int64]
    table_block: NDArray[np.int32]
    key: NDArray[np.int64]
    value: Floats
    expected: Floats
    coefficient: Floats
    neighbour: NDArray[np.int32]
    touched: NDArray[np.int32]
    filtered: NDArray[np.int32]


AnyBlocks = TypeVar('AnyBlocks', bound=Any)


def new_blocks(capacity: int = 1024) -> Blocks:
    """Return a lattice that holds block 0 only."""
    table = 1 << (4 * capacity - 1).bit_length()
    return Blocks(
        1, np.zeros(table, np.int64), np.zeros(table, np.int32), np.full(capacity, -1, np.int64),
        _room(capacity * VOXELS), _room(capacity * VOXELS), _room(capacity * COEFFICIENTS),
        np.zeros((capacity, 27), np.int32), np.zeros(capacity, np.int32),
        np.zeros(capacity, np.int32))


def _room(count: int) -> Floats:
    """Return zeros in pages of their own, so that a part can be given back; see block_removal."""
    return np.frombuffer(
        mmap.mmap(-1, 4 * count, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), np.float32)


def with_keys(
    blocks: AnyBlocks, keys: NDArray[np.int64], change: int, most: int = NO_LIMIT,
    new: Callable[[int], Any] = new_blocks,
) -> tuple[AnyBlocks, NDArray[np.int32]]:
    """
    Make sure that blocks exist, growing by doubling, and mark them as changed.

    :param blocks: Blocks, or a tuple that begins alike and has neighbour and touched
    :param keys: (n,) int64, in any order, repeated or not
    :param change: the number of the change, greater than all before
    :param most: where no more blocks than this are expected, the last doublings are one step: a
        lattice that grows is there twice, and what is reserved takes no memory before it is used
    :param new: makes one that holds block 0 only, of a capacity
    :return: the lattice and the blocks' numbers, each once, in the order of the keys
    """
    found = np.zeros(len(keys), np.int32)
    size, count, done = blocks.size, 0, 0
    while True:
        size, count, done = _insert(blocks, size, keys, done, change, found, count)
        if done == len(keys):
            return blocks._replace(size=size), found[:count].copy()
        capacity = 2 * size
        if size < most <= _LAST_STEP * size:
            capacity = most
        blocks = _grown(blocks._replace(size=size), new(capacity))


def capacity_for(size: int) -> int:
    """Return what new_blocks may be asked for to hold a number of blocks."""
    return 1 << max(size - 1, 1023).bit_length()


def linked(blocks: Blocks, size: int) -> Blocks:
    """
    Return the lattice with the hash and the neighbours of blocks whose keys were filled in.

    :param blocks: of new_blocks
    :param size: number of blocks, block 0 included
    """
    _rehash(blocks.table_key, blocks.table_block, blocks.key, size)
    _link_all(blocks, size)
    return blocks._replace(size=size)


def _grown(blocks: AnyBlocks, grown: AnyBlocks) -> AnyBlocks:
    for name in blocks._fields[3:]:
        old = getattr(blocks, name)
        getattr(grown, name)[:len(old)] = old
    _rehash(grown.table_key, grown.table_block, grown.key, blocks.size)
    larger: AnyBlocks = grown._replace(size=blocks.size)
    return larger


@njit(cache=True, nogil=True)
def key_of(x: Any, y: Any, z: Any) -> np.int64:
    """Return the key of the block with these numbers."""
    key: np.int64 = (
        (int64(x) + _OFFSET) | ((int64(y) + _OFFSET) << _BITS)
        | ((int64(z) + _OFFSET) << (2 * _BITS)))
    return key


@njit(cache=True, nogil=True)
def with_room(keys: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the keys with room behind the first count, doubled where there is none."""
    if count < len(keys):
        return keys
    longer = np.zeros(2 * count, np.int64)
    longer[:count] = keys
    return longer


@njit(cache=True, nogil=True)
def place_of(key: np.int64) -> tuple[np.int64, np.int64, np.int64]:
    """Return the block numbers (x, y, z) of a key."""
    return (
        (key & _MASK) - _OFFSET, ((key >> _BITS) & _MASK) - _OFFSET,
        ((key >> (2 * _BITS)) & _MASK) - _OFFSET)


@njit(cache=True, nogil=True)
def places_of(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the block numbers (n, 3) of some keys."""
    out = np.zeros((len(keys), 3), np.int64)
    for n in range(len(keys)):
        out[n, 0], out[n, 1], out[n, 2] = place_of(keys[n])
    return out


@njit(cache=True, nogil=True)
def first_slot(table_key: NDArray[np.int64], key: np.int64) -> Any:
    """Return where a key goes in an empty hash, uint64."""
    mixed = uint64(key) * uint64(0x9E3779B97F4A7C15)
    return (mixed ^ (mixed >> uint64(32))) & uint64(len(table_key) - 1)


@njit(cache=True, nogil=True)
def slot_of(
    table_key: NDArray[np.int64], table_block: NDArray[np.int32], key: np.int64
) -> np.int64:
    """Return where a key is in the hash, or where it would go."""
    mask = uint64(len(table_key) - 1)
    slot = first_slot(table_key, key)
    while table_block[slot] != 0 and table_key[slot] != key:
        slot = (slot + uint64(1)) & mask
    return np.int64(slot)


@njit(cache=True, nogil=True)
def find(
    table_key: NDArray[np.int64], table_block: NDArray[np.int32], key: np.int64
) -> np.int64:
    """Return the number of the block with a key, 0 where there is none."""
    return np.int64(table_block[slot_of(table_key, table_block, key)])


@njit(cache=True, nogil=True)
def _rehash(
    table_key: NDArray[np.int64], table_block: NDArray[np.int32], key: NDArray[np.int64],
    size: int,
) -> None:
    for block in range(1, size):
        slot = slot_of(table_key, table_block, key[block])
        table_key[slot] = key[block]
        table_block[slot] = block


@uncounted()
def _insert(
    blocks: Blocks, size: int, keys: NDArray[np.int64], done: int, change: int,
    found: NDArray[np.int32], count: int,
) -> tuple[int, int, int]:
    for i in range(done, len(keys)):
        slot = slot_of(blocks.table_key, blocks.table_block, keys[i])
        block = int64(blocks.table_block[slot])
        if block == 0:
            if size == len(blocks.key):
                return size, count, i
            block = size
            size += 1
            blocks.table_key[slot] = keys[i]
            blocks.table_block[slot] = block
            blocks.key[block] = keys[i]
            _link(blocks, block)
        if blocks.touched[block] != change:
            blocks.touched[block] = change
            found[count] = block
            count += 1
    return size, count, len(keys)


@uncounted()
def _link(blocks: Blocks, block: int) -> None:
    """Enter a new block in its neighbours' lists, and them in its own."""
    x, y, z = place_of(blocks.key[block])
    for n in range(27):
        key = key_of(x + n % 3 - 1, y + n // 3 % 3 - 1, z + n // 9 - 1)
        other = find(blocks.table_key, blocks.table_block, key)
        if other != 0:
            blocks.neighbour[block, n] = other
            blocks.neighbour[other, 26 - n] = block


@njit(cache=True, nogil=True)
def _link_all(blocks: Blocks, size: int) -> None:
    for block in range(1, size):
        _link(blocks, block)


@njit(cache=True, nogil=True)
def with_neighbours(
    blocks: Blocks, changed: NDArray[np.int32], change: int
) -> NDArray[np.int32]:
    """Return the blocks whose coefficients depend on changed ones, each once; mark them."""
    out = np.zeros(27 * len(changed), np.int32)
    count = 0
    for block in changed:
        for n in range(27):
            other = blocks.neighbour[block, n]
            if other != 0 and blocks.filtered[other] != change:
                blocks.filtered[other] = change
                out[count] = other
                count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def prefilter(blocks: Blocks, chosen: NDArray[np.int32]) -> None:
    """Compute the chosen blocks' own coefficients from the values in and about them."""
    # rows of 16, of which 12 are used
    _prefilter(
        blocks, chosen, np.zeros(144 * 16, np.float32), np.zeros(144 * SIDE, np.float32),
        np.zeros(12 * SIDE * SIDE, np.float32))


@uncounted()
def _prefilter(
    blocks: Blocks, chosen: NDArray[np.int32], wide: Floats, along_x: Floats, along_y: Floats
) -> None:
    """
    Filter along x, then y, then z.

    :param wide: the block's values and two more on each side; with along_x and along_y scratch
    """
    value, coefficient, neighbour = blocks.value, blocks.coefficient, blocks.neighbour
    for block in chosen:
        for nz in range(3):
            z_first, z_end = 8 * nz - 6, min(8 * nz + 2, 12)
            for ny in range(3):
                y_first, y_end = 8 * ny - 6, min(8 * ny + 2, 12)
                n = 9 * nz + 3 * ny
                left = int64(neighbour[block, n]) * VOXELS
                middle = int64(neighbour[block, n + 1]) * VOXELS
                right = int64(neighbour[block, n + 2]) * VOXELS
                for z in range(max(z_first, 0), z_end):
                    for y in range(max(y_first, 0), y_end):
                        line = ((z - z_first) * SIDE + y - y_first) * SIDE
                        to = (12 * z + y) * 16
                        wide[to] = value[left + line + 6]
                        wide[to + 1] = value[left + line + 7]
                        copy_eight(value, middle + line, wide, to + 2)
                        wide[to + 10] = value[right + line]
                        wide[to + 11] = value[right + line + 1]
        for row in range(144):
            five_taps(wide, 16 * row, 1, _TAP0, _TAP1, _TAP2, along_x, SIDE * row)
        for z in range(12):
            for y in range(SIDE):
                five_taps(
                    along_x, 96 * z + SIDE * y, SIDE, _TAP0, _TAP1, _TAP2,
                    along_y, 64 * z + SIDE * y)
        for row in range(64):
            five_taps(
                along_y, SIDE * row, 64, _TAP0, _TAP1, _TAP2,
                coefficient, int64(block) * COEFFICIENTS + ROW * row)


@uncounted()
def copy_margins(blocks: Blocks, chosen: NDArray[np.int32]) -> None:
    """Copy the first coefficients of the chosen blocks' rows behind the rows before them."""
    for block in chosen:
        before = int64(blocks.neighbour[block, _SELF - 1])
        if before == 0:
            continue
        for line in range(64):
            source = int64(block) * COEFFICIENTS + line * ROW
            target = before * COEFFICIENTS + line * ROW + 8
            for x in range(3):
                blocks.coefficient[target + x] = blocks.coefficient[source + x]


@njit(cache=True, nogil=True)
def values_at(
    blocks: Blocks, values: Floats, voxels: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return a field's values at whole voxels (n, 3); 0 where there is no block."""
    out = np.zeros(len(voxels))
    for n in range(len(voxels)):
        x, y, z = voxels[n]
        block = find(blocks.table_key, blocks.table_block, key_of(x >> 3, y >> 3, z >> 3))
        out[n] = values[block * VOXELS + ((z & 7) * SIDE + (y & 7)) * SIDE + (x & 7)]
    return out
