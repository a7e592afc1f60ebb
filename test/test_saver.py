# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Maps outlive the node, and never take another map's file."""
from collections.abc import Callable
from pathlib import Path
import re
from typing import Any

import pytest
from test_map_file import assert_same_state
from worker_for_tests import COUNT, LIMIT, Rig

from gr2t_ros.errors import Gr2tError
from gr2t_ros.io.map_file import MapFile
from gr2t_ros.ros import saver

Make = Callable[..., Rig]


def fed(rig: Rig) -> Rig:
    before = rig.worker.views
    rig.feed()
    rig.wait(lambda: rig.worker.views == before + COUNT, 'all frames')
    rig.wait(lambda: not rig.worker.waiting_rays, 'all rays')
    return rig


def save(rig: Rig) -> Path:
    return Path(rig.worker.saver.save_map().result(LIMIT).partition(': ')[0])


def load(rig: Rig) -> str:
    return rig.worker.saver.load_map().result(LIMIT)


def test_another_node_goes_on_with_the_map(make_worker: Make, tmp_path: Path) -> None:
    """It is bit for bit what the first would have had."""
    first = fed(make_worker(keyframe_translation=0.0))
    path = save(first)
    assert re.fullmatch(r'map_\d{8}_\d{6}\.gr2t', path.name)
    assert path.parent == tmp_path / 'snapshots'
    second = make_worker(keyframe_translation=0.0)
    assert load(second) == f'{path}: {COUNT} views, {COUNT} keyframes'
    assert second.worker.views == COUNT and second.worker.intake.world.frame == 'map'
    assert second.outputs.changed == set(range(COUNT))
    second.wait(lambda: second.outputs.published, 'the loaded map\'s publication')
    for rig in (first, second):
        fed(rig)
    assert_same_state(second.worker._reconstruction, first.worker._reconstruction)


def test_a_map_is_saved_in_its_own_file(make_worker: Make) -> None:
    """Again in the same, but never in that of another map: of before a reset, or another node."""
    rig, other = fed(make_worker()), fed(make_worker())
    first = save(rig)
    fed(rig)
    assert save(rig) == first and MapFile(first).views == 2 * COUNT
    theirs = save(other)
    assert theirs != first
    rig.worker.reset()
    with pytest.raises(Gr2tError, match='nothing to save yet'):
        save(rig)
    second = save(fed(rig))
    load(rig)
    third = save(rig)
    assert len({first, theirs, second, third}) == 4
    assert [MapFile(path).views for path in (first, theirs, second, third)] == [
        2 * COUNT, COUNT, COUNT, COUNT]


def test_the_file_may_be_named(make_worker: Make, tmp_path: Path) -> None:
    rig = fed(make_worker())
    path = save(rig)
    path.rename(path.with_name('kitchen.gr2t'))
    fed(rig)
    save(rig)
    other = make_worker(map_file='kitchen.gr2t')
    assert 'kitchen.gr2t: 5 views' in load(other)
    settings = other.worker._settings
    secret = tmp_path / 'secret.gr2t'
    path.rename(secret)
    (tmp_path / 'snapshots' / 'link.gr2t').symlink_to(secret)
    for name in ('../secret.gr2t', str(secret), 'link.gr2t', '..'):
        other.worker.update(settings.updated({'map_file': name}))
        other.worker.copy(())
        with pytest.raises(Gr2tError, match='is not the name of a file in'):
            load(other)
    assert other.worker.views == COUNT, 'the map stays'


def test_what_cannot_be_loaded_leaves_the_map(make_worker: Make, tmp_path: Path) -> None:
    rig = make_worker()
    with pytest.raises(Gr2tError, match='there is no map in'):
        load(rig)
    path = save(fed(make_worker(depth_bandwidth=0.004)))
    fed(rig)
    with pytest.raises(Gr2tError, match=r'depth_bandwidth is 0\.004 there and 0\.003 here'):
        load(rig)
    with pytest.raises(Gr2tError, match="world frame 'map', but this node builds in 'odom'"):
        load(make_worker(depth_bandwidth=0.004, world_frame='odom'))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(Gr2tError, match='truncated or altered'):
        load(rig)
    assert rig.worker.views == COUNT and rig.outputs.cleared == []


def test_maps_are_saved_by_themselves(make_worker: Make, tmp_path: Path) -> None:
    """Every map_period while there is something new, and at the end."""
    rig = fed(make_worker(map_period=0.01))
    rig.wait(lambda: rig.worker.saver._maps.saved == (1, COUNT), 'a map with all frames')
    rig.wait(lambda: rig.said('periodic map: /'), 'that it was written')
    path, = tmp_path.glob('snapshots/*.gr2t')
    rig.worker.stop()
    assert rig.said(f'map: {path}: {COUNT} views')
    assert list(tmp_path.glob('snapshots/*.gr2t')) == [path] and MapFile(path).views == COUNT
    empty = make_worker(map_period=0.01)
    empty.worker.stop()
    assert empty.said('map') == 0, 'an empty map is not saved'


def test_a_periodic_map_that_cannot_be_written(make_worker: Make, tmp_path: Path) -> None:
    (tmp_path / 'snapshots').write_text('a file')
    rig = fed(make_worker(map_period=0.01))
    rig.wait(lambda: rig.worker.saver.problem, 'the problem')
    assert 'no periodic map: cannot write to' in rig.worker.saver.problem
    (tmp_path / 'snapshots').unlink()
    fed(rig)
    rig.wait(lambda: not rig.worker.saver.problem, 'the next one')


def test_a_reset_while_a_map_is_written(
    make_worker: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is that of the map that was; the next map gets another."""
    rig = fed(make_worker())
    write = saver.save_map

    def slow(*arguments: Any, **options: Any) -> Any:
        rig.worker.reset()
        rig.wait(lambda: rig.worker.views == 0, 'the reset')
        return write(*arguments, **options)

    monkeypatch.setattr(saver, 'save_map', slow)
    first = save(rig)
    monkeypatch.undo()
    assert MapFile(first).views == COUNT
    assert save(fed(rig)) != first


def test_after_the_end(make_worker: Make) -> None:
    rig = make_worker()
    rig.worker.stop()
    for ask in (rig.worker.saver.snapshot, rig.worker.saver.save_map, rig.worker.saver.load_map):
        with pytest.raises(Gr2tError, match='told to stop'):
            ask().result(LIMIT)
