# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A map that was saved and loaded goes on as if nothing had happened; a damaged one is refused."""
from collections.abc import Iterator
from dataclasses import fields, replace
import hashlib
from itertools import islice
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes_for_tests import bumpy_views, plane_view, pose

from gr2t_ros.core.blocks import Blocks
from gr2t_ros.core.camera import Camera
from gr2t_ros.core.exact_query import Views
from gr2t_ros.core.frozen import room_for
from gr2t_ros.core.ray_march import Rays
from gr2t_ros.core.reconstruction import Keyframe, Reconstruction
from gr2t_ros.core.state import ADDING, columns_of, state_of
from gr2t_ros.core.view import View
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.errors import FrameError, Gr2tError, InputError
from gr2t_ros.io import topics
from gr2t_ros.io.bags import Bag
from gr2t_ros.io.frames import FrameAssembler
from gr2t_ros.io.map_file import MapFile, save_map
from gr2t_ros.io.views import views
from gr2t_ros.settings import Settings

# rays wait, so that they are part of what is saved
SETTINGS = Settings(
    depth_bandwidth=0.004, keyframe_translation=0.0, threads=2, voxel_size=0.005,
    remarch_budget=0.0)


def built(some: list[View], settings: Settings) -> Reconstruction:
    reconstruction = Reconstruction(settings)
    for view in some:
        reconstruction.add(view)
    return reconstruction


def loaded(path: Path, settings: Settings) -> Reconstruction:
    reconstruction = Reconstruction(settings)
    with MapFile(path) as file:
        file.load(reconstruction)
    return reconstruction


def assert_same_state(ours: Reconstruction, theirs: Reconstruction) -> None:
    """Every bit that is saved is the same, and what is made from it too."""
    a, b = state_of(ours), state_of(theirs)
    assert a.numbers == b.numbers
    assert a.columns.keys() == b.columns.keys()
    for name, pieces in a.columns.items():
        assert len(pieces) == len(b.columns[name]), name
        for ours_, theirs_ in zip(pieces, b.columns[name]):
            assert ours_.dtype == theirs_.dtype
            np.testing.assert_array_equal(
                ours_.view(np.uint8), theirs_.view(np.uint8), err_msg=name)
    assert len(ours.keyframes) == len(theirs.keyframes)
    for (_, c), (_, d) in zip(ours.meshes(), theirs.meshes()):
        for name in vars(c):
            np.testing.assert_array_equal(getattr(c, name), getattr(d, name), err_msg=name)


@pytest.fixture(scope='module')
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small map."""
    path = tmp_path_factory.mktemp('map') / 'map.gr2t'
    save_map(path, built(bumpy_views()[:2], SETTINGS), 'map')
    return path


@pytest.mark.parametrize('density', ['voxel', 'exact'])
@pytest.mark.parametrize('finished', [True, False], ids=['finished', 'rays wait'])
def test_it_goes_on_as_if_it_had_not_been_interrupted(
    tmp_path: Path, density: str, finished: bool
) -> None:
    """Also where its voxel size followed from the first frame."""
    settings = SETTINGS.updated(
        {'density': density, 'voxel_size': 0.0, 'cameras': ('front', 'rear')})
    some = [replace(view, stamp_ns=10 + n, frame_id='optical', camera_name='front')
            for n, view in enumerate(bumpy_views() + bumpy_views(1))]
    whole, half = built(some[:5], settings), built(some[:5], settings)
    assert finished or half.finish(0.0).waiting
    if finished:
        whole.finish(), half.finish()
    path = tmp_path / 'map.gr2t'
    said = save_map(path, half, 'odom')
    assert (said.views, said.size) == (5, path.stat().st_size) and str(path) in str(said)
    with MapFile(path) as file:
        assert (file.world_frame, file.views, file.stamp_ns) == ('odom', 5, 14)
        assert file.settings == settings
    half = loaded(path, settings)
    assert_same_state(half, whole)
    for view in some[5:]:
        assert half.add(view).remarched == whole.add(view).remarched
    assert_same_state(half, whole)
    assert half.finish().remarched == whole.finish().remarched
    assert_same_state(half, whole)


def test_keyframes_that_left_memory_stay_known(tmp_path: Path) -> None:
    """With blocks that are gone, and a spline beside them that follows from what is left."""
    settings = SETTINGS.updated({
        'voxel_size': 0.02, 'depth_bandwidth': 0.02, 'max_keyframes': 9, 'depth_max': 0.8})
    camera = Camera(80, 60, 90.0, 90.0, 39.5, 29.5)
    some = [plane_view(camera, pose([0, 0, 0], [0.2 * n, 0, 0]), [0, 0, 1], 0.5)
            for n in range(40)]
    whole, left = built([], settings), []
    whole.sink = lambda number, mesh, colouring: left.append(number)
    for view in some[:-8]:
        whole.add(view)
    assert left and whole.keyframes[0].released
    path = tmp_path / 'map.gr2t'
    save_map(path, whole, 'map')
    part = loaded(path, settings)
    part.sink = whole.sink
    assert_same_state(part, whole)
    for view in some[-8:]:
        whole.add(view)
        part.add(view)
    assert left[-1] == left[-2], 'both released it'
    assert_same_state(part, whole)


@pytest.mark.parametrize('density', ['voxel', 'exact'])
def test_of_a_recording(tmp_path: Path, data: Path, density: str) -> None:
    settings = Settings(
        density=density, ray_stride=4, keyframe_translation=0.02, remarch_budget=0.0,
        voxel_size=0.02)
    frames = iter(islice(kitchen(data, settings), 10 if density == 'voxel' else 4))
    whole = Reconstruction(settings)
    parts: Reconstruction | None = None
    for number, view in enumerate(frames):
        whole.add(view)
        if parts is None:
            parts = Reconstruction(settings)
        parts.add(view)
        if number % 3 == 1:
            save_map(tmp_path / 'map.gr2t', parts, 'map')
            parts = loaded(tmp_path / 'map.gr2t', settings)
    assert parts is not None
    whole.finish(), parts.finish()
    assert_same_state(parts, whole)


def kitchen(data: Path, settings: Settings) -> Iterator[View]:
    with Bag([data / 'bags' / 'kitchen_30hz']) as bag:
        sources = topics.choose(bag)
        assembler = FrameAssembler(
            settings.updated({'world_frame': sources.poses.world_frame}),
            rectified=sources.depth.rectified, max_waiting=100)
        yield from views(bag, sources, assembler)


@pytest.mark.parametrize('density', ['voxel', 'exact'])
def test_of_a_copy_while_views_come(tmp_path: Path, density: str) -> None:
    settings = SETTINGS.updated({'density': density})
    some = bumpy_views()
    original = built(some[:2], settings)
    copy = original.frozen(room_for(original.density, ADDING), ADDING)
    for view in some[2:]:
        original.add(view)
    original.finish()
    save_map(tmp_path / 'map.gr2t', copy, 'map')
    assert_same_state(loaded(tmp_path / 'map.gr2t', settings), built(some[:2], settings))


def test_nothing_is_forgotten() -> None:
    """All that a map consists of is saved, or follows from what is; new fields belong here."""
    assert set(Blocks._fields) == {
        *ADDING, 'size', 'table_key', 'table_block', 'coefficient', 'neighbour'}
    saved = columns_of('voxel')
    assert {item.name for item in fields(Rays) if item.init} == {
        *(name.partition('_')[2] for name in saved if name.startswith('ray_')),
        'table', 'T_world_camera'}
    assert {item.name for item in fields(Keyframe)} == {
        'view', 'rays', 'blocks', 'checked', 'released', 'shared'}
    assert {f'view_{name}' for name in Views._fields} == {
        'view_size', *(name for name in columns_of('exact') if name.startswith('view_'))}
    assert set(vars(VoxelDensity(1.5, 0.003, 0.002, 0.01, 5.0))) == {
        # saved
        'voxel_size', 'depth_max', 'blocks', 'size', 'pixels', 'aliased_pixels', '_change',
        # from the settings
        'pixel_bandwidth', 'bandwidth', 'scale', 'weights', '_depth_of_bins', 'most_blocks',
        # of the moment: empty when the spline is up to date
        '_recent', '_stale'}


def test_other_settings(saved: Path) -> None:
    """What the density was built with must be the same, and the sentence says what is not."""
    other = SETTINGS.updated({'depth_bandwidth': 0.005, 'voxel_size': 0.004})
    with pytest.raises(InputError) as refused:
        loaded(saved, other)
    assert 'depth_bandwidth is 0.004 there and 0.005 here' in str(refused.value)
    assert 'voxel_size is 0.005 there and 0.004 here' in str(refused.value)
    assert 'ray_stride' not in str(refused.value)
    loaded(saved, SETTINGS.updated({
        'voxel_size': 0.0, 'min_confidence': 0.5, 'threads': 1, 'keyframe_translation': 1.0}))


def test_nothing_is_written_of_nothing(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match='no map yet'):
        save_map(tmp_path / 'map.gr2t', Reconstruction(SETTINGS), 'map')
    with pytest.raises(Gr2tError, match='told to stop'):
        save_map(tmp_path / 'map.gr2t', built(bumpy_views()[:1], SETTINGS), 'map',
                 interrupted=lambda: True)
    assert list(tmp_path.iterdir()) == []


def test_altered_anywhere(saved: Path, tmp_path: Path) -> None:
    """A flipped bit is found wherever it is: in the header, in a column, in the checksum."""
    content = saved.read_bytes()
    rng = np.random.default_rng(0)
    places = [*range(200), *rng.integers(0, len(content), 200), *range(-32, 0)]
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        refused(tmp_path, bytes(damaged))


def test_cut_off_anywhere(saved: Path, tmp_path: Path) -> None:
    content = saved.read_bytes()
    rng = np.random.default_rng(1)
    for length in [*range(60), *rng.integers(0, len(content), 100), len(content) - 1]:
        refused(tmp_path, content[:length])
    refused(tmp_path, content + b'x')


def test_what_is_not_a_map(saved: Path, tmp_path: Path) -> None:
    assert 'not a map' in refused(tmp_path, b'ply\nformat binary_little_endian 1.0\n')
    assert "version '2'" in refused(
        tmp_path, saved.read_bytes().replace(b'map 1', b'map 2', 1))
    for path in (tmp_path / 'absent.gr2t', tmp_path):
        with pytest.raises(InputError, match=f'{path.name}'):
            MapFile(path)
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(InputError, match='not a file'):
        MapFile(tmp_path / 'pipe')


@pytest.mark.parametrize('density', ['voxel', 'exact'])
def test_made_to_harm(tmp_path: Path, density: str) -> None:
    """Sizes and indices that point elsewhere are found though the checksum fits."""
    path = tmp_path / 'map.gr2t'
    settings = SETTINGS.updated({'density': density})
    save_map(path, built(bumpy_views()[:2], settings), 'map')
    line, _, rest = path.read_bytes().partition(b'\n')
    length = int.from_bytes(rest[:8], 'little')
    header, content = json.loads(rest[8:8 + length]), rest[8 + length:-32]

    def write(header: Any, content: bytes) -> None:
        text = json.dumps(header).encode() if isinstance(header, dict) else header
        whole = line + b'\n' + len(text).to_bytes(8, 'little') + text + content
        path.write_bytes(whole + hashlib.sha256(whole).digest())

    write(header, content)
    loaded(path, settings)
    begin = 0
    for name, (dtype, shape) in columns_of(density).items():
        count = header['rows'][name]
        end = begin + count * np.dtype(dtype).itemsize * int(np.prod(shape))
        for wrong in (2 ** 60, -1, count + 1, 1.5, None, 'x'):
            write({**header, 'rows': {**header['rows'], name: wrong}}, content)
            with pytest.raises(InputError, match='contradicts'):
                loaded(path, settings)
        for value in (b'\x7f', b'\xff'):
            write(header, content[:begin] + value * (end - begin) + content[end:])
            try:
                loaded(path, settings).close()
            except InputError:
                continue
            assert name in _HARMLESS or not count, name
        begin = end
    for text in (b'', b'[]', b'{}', b'[' * 100_000, b'\xff', b'{"settings": 1}'):
        write(text, content)
        with pytest.raises(InputError, match=r'map\.gr2t'):
            loaded(path, settings)
    for name in ('cameras', 'views', 'settings', 'stamp_ns'):
        for value in (None, [{}], 'x', 10 ** 400):
            write({**header, name: value}, content)
            with pytest.raises(InputError, match=r'map\.gr2t'):
                loaded(path, settings)


# wrong numbers in them give wrong meshes, but lead nowhere
_HARMLESS = {
    'block_value', 'block_expected', 'block_touched', 'block_filtered', 'view_T_camera_world',
    'view_camera', 'view_factor', 'view_depth', 'view_precision', 'view_near', 'view_far',
    'keyframe_stamp_ns', 'keyframe_checked', 'keyframe_image', 'ray_depth', 'ray_total',
    'ray_curvature', 'ray_status', 'ray_iterations', 'ray_marched'}


def refused(folder: Path, content: bytes) -> str:
    path = folder / 'other.gr2t'
    path.write_bytes(content)
    with pytest.raises(InputError, match=r'other\.gr2t') as error:
        MapFile(path)
    assert '\n' not in str(error.value)
    return str(error.value)
