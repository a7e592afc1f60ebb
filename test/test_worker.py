# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The worker without ROS: it is fed with a recording's messages."""
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import re
import threading
from typing import Any

import numpy as np
import pytest
from scenes_for_tests import plane_view, pose
from worker_for_tests import COUNT, LIMIT, Rig

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.reconstruction import Reconstruction, Update
from gr2t_ros.core.view import View
from gr2t_ros.errors import Gr2tError, InputError
from gr2t_ros.io import snapshots
from gr2t_ros.io.formats import read
from gr2t_ros.io.ply import write_fused, Written
from gr2t_ros.settings import Settings
from gr2t_ros.tools.recorder import CAMERA_INFO_TOPIC, DEPTH_TOPIC, record

WALL = 14  # frames


def test_all_frames_are_integrated_and_published(make_worker: Callable[..., Rig]) -> None:
    rig = make_worker()
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    rig.wait(lambda: rig.outputs.published[-1:] and rig.outputs.published[-1][2] == COUNT,
             'the last frame\'s publication')
    frame, stamp_ns, _ = rig.outputs.published[-1]
    assert frame == 'map'
    assert stamp_ns == 1_700_000_000_400_000_000
    assert rig.outputs.changed == set(range(max(rig.outputs.changed) + 1))
    assert rig.dropped == {}
    rig.worker.stop()
    summary = rig.worker.summary()
    assert '5 received, 5 integrated, 0 dropped, 0 waiting' in summary
    for stage in ('queue', 'queue and pose', 'integrate', 'march'):
        assert re.search(rf'^{stage} +5 ', summary, re.MULTILINE), summary
    assert 'stamp to publish' not in summary, 'the recording is old'
    assert rig.worker.busy > 0


def test_a_full_queue_loses_the_oldest_images(make_worker: Callable[..., Rig]) -> None:
    rig = make_worker(start=False, queue_size=2)
    rig.feed()
    assert rig.dropped == {'queue_full': COUNT - 2}
    rig.worker.start()
    rig.wait(lambda: rig.integrated == 2, 'the other frames')
    rig.wait(lambda: rig.outputs.published, 'a publication')
    rig.wait(lambda: rig.outputs.published[-1][1] == 1_700_000_000_400_000_000, 'the newest')
    assert rig.said('queue_full') == 1


def test_one_frame_that_fails_costs_itself_only(
    make_worker: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    add = Reconstruction.add

    def fails_once(self: Reconstruction, view: View, load: float) -> Update:
        if view.stamp_ns == 1_700_000_000_200_000_000:
            raise ZeroDivisionError('a defect')
        return add(self, view, load)

    monkeypatch.setattr(Reconstruction, 'add', fails_once)
    rig = make_worker()
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT - 1, 'the other frames')
    assert rig.dropped == {'error': 1}
    assert rig.said('the frame of 1700000000.200 s failed: ZeroDivisionError: a defect') == 1


def test_what_fails_again_and_again_is_said_while_it_does(
    make_worker: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    add, wrong = Reconstruction.add, threading.Event()

    def fails(self: Reconstruction, view: View, load: float) -> Update:
        if wrong.is_set():
            raise ZeroDivisionError('a defect')
        return add(self, view, load)

    monkeypatch.setattr(Reconstruction, 'add', fails)
    rig = make_worker()
    assert rig.worker.failing == ''
    wrong.set()
    rig.feed()
    rig.wait(lambda: rig.dropped == {'error': COUNT}, 'the frames to fail')
    assert rig.worker.failing == (
        'frames fail again and again: ZeroDivisionError: a defect')
    wrong.clear()
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'the next frames')
    assert rig.worker.failing == ''


def test_what_listeners_do_costs_no_frame(make_worker: Callable[..., Rig]) -> None:
    """Publishing that fails is logged with its place once, and the frames go on."""
    rig = make_worker()

    def broken(*_: Any) -> bool:
        raise OSError('no such publisher')

    rig.outputs.publish = broken
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    rig.wait(lambda: rig.worker.failing, 'the failure')
    assert 'publishing fail again and again: OSError: no such publisher' in rig.worker.failing
    assert rig.said('in broken') == 1
    assert rig.dropped == {}


def test_paused_images_are_counted(make_worker: Callable[..., Rig]) -> None:
    rig = make_worker()
    rig.worker.intake.pause(True)
    rig.feed()
    assert rig.dropped == {'paused': COUNT}
    rig.worker.intake.pause(False)
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'the frames after the pause')


def test_reset_empties_the_map(make_worker: Callable[..., Rig]) -> None:
    rig = make_worker()
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    rig.worker.reset()
    with pytest.raises(InputError, match='nothing to save'):
        rig.worker.saver.snapshot().result(LIMIT)
    assert rig.outputs.cleared == ['map']
    rig.feed()
    rig.wait(lambda: rig.integrated == 2 * COUNT, 'the frames after the reset')
    assert rig.worker.saver.snapshot().result(LIMIT).file.vertices > 0


def test_reset_and_pause_do_not_wait_for_a_frame(
    make_worker: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What waits when a reset comes is not part of the new map."""
    add, go, busy = Reconstruction.add, threading.Event(), threading.Event()

    def slow(self: Reconstruction, view: View, load: float) -> Update:
        busy.set()
        assert go.wait(LIMIT)
        return add(self, view, load)

    monkeypatch.setattr(Reconstruction, 'add', slow)
    rig = make_worker()
    rig.feed()
    assert busy.wait(LIMIT)
    rig.worker.reset()
    rig.worker.intake.pause(True)
    answer = rig.worker.saver.snapshot()
    go.set()
    with pytest.raises(InputError, match='nothing to save'):
        answer.result(LIMIT)
    assert rig.dropped == {'reset': COUNT - 1}
    assert rig.outputs.cleared == ['map']


def test_every_snapshot_has_a_new_name(make_worker: Callable[..., Rig], tmp_path: Path) -> None:
    rig = make_worker()
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    paths = [rig.worker.saver.snapshot().result(LIMIT).file.path for _ in range(3)]
    assert len(set(paths)) == 3
    for path in paths:
        assert path.parent == tmp_path / 'snapshots'
        assert np.abs(read(path).vertices[:, 2]).max() < 0.02


def test_no_frame_waits_for_a_snapshot(
    make_worker: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames go on while the file is written, which holds the map as it was when asked for."""
    go, busy = threading.Event(), threading.Event()

    def slow(*arguments: Any, **options: Any) -> Written:
        busy.set()
        assert go.wait(LIMIT)
        return write_fused(*arguments, **options)

    rig = make_worker(keyframe_translation=0.0)
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    monkeypatch.setattr(snapshots, 'write_fused', slow)
    answer, later = rig.worker.saver.snapshot(), rig.worker.saver.snapshot()
    assert busy.wait(LIMIT)
    rig.feed()
    rig.wait(lambda: rig.integrated == 2 * COUNT, 'frames during the snapshot')
    rig.worker.reset()
    go.set()
    saved = answer.result(LIMIT)
    attributes = read(saved.file.path).attributes
    assert attributes['views'].max() == COUNT
    likelihood = attributes['likelihood']
    assert saved.likelihood == (likelihood.min(), likelihood.max())
    assert str(saved).startswith(f'{saved.file.path}: {saved.file.vertices} vertices, ')
    with pytest.raises(InputError, match='nothing to save'):
        later.result(LIMIT)


def test_a_stop_gives_up_what_is_being_written(
    make_worker: Callable[..., Rig], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """No part of a file stays; all who wait are told."""
    busy = threading.Event()
    fuse = Reconstruction.fuse

    def slow(self: Reconstruction) -> Any:
        busy.set()
        rig.wait(lambda: rig.worker._stop, 'the stop')
        return fuse(self)

    monkeypatch.setattr(Reconstruction, 'fuse', slow)
    rig = make_worker()
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    answers = [rig.worker.saver.snapshot(), rig.worker.saver.snapshot()]
    assert busy.wait(LIMIT)
    rig.worker.stop()
    for answer in answers:
        with pytest.raises(Gr2tError, match='told to stop'):
            answer.result(LIMIT)
    assert list(tmp_path.glob('snapshots/*')) == []


def test_periodic_snapshots_of_what_is_new(
    make_worker: Callable[..., Rig], tmp_path: Path,
) -> None:
    rig = make_worker(snapshot_period=0.01)
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    rig.wait(lambda: rig.said('periodic snapshot'), 'a snapshot')
    rig.feed()
    rig.wait(lambda: rig.integrated == 2 * COUNT, 'more frames')
    rig.wait(lambda: rig.worker.saver._snapshots.saved == (1, 2 * COUNT), 'a snapshot of them')
    rig.worker.stop()
    assert rig.said('periodic snapshot') <= 2 * COUNT, 'none without new frames'
    assert rig.said('periodic snapshot: /') == len(list(tmp_path.glob('snapshots/*.ply')))


def test_parameters_change_while_it_runs(make_worker: Callable[..., Rig]) -> None:
    """Depth limits hold for the next images; what the map cannot follow is said."""
    rig = make_worker(density='voxel', depth_max=5.0)
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    rig.outputs.changed.clear()
    settings = Settings().updated({'depth_max': 0.5, 'depth_min': 0.2, 'publish_rate': 60.0})
    rig.worker.update(settings)
    rig.wait(lambda: rig.outputs.changed, 'the meshes to be sent again')
    assert rig.outputs.settings == settings
    rig.feed()
    rig.wait(lambda: rig.worker.intake.cameras[''].dropped, 'depths beyond the new limit')
    rig.worker.update(settings.updated({'depth_max': 8.0}))
    rig.wait(lambda: rig.said('the map was begun with 5 m'), 'the warning')


def test_a_snapshot_on_exit_where_asked(make_worker: Callable[..., Rig], tmp_path: Path) -> None:
    for wanted in (False, True):
        rig = make_worker(snapshot_on_exit=wanted)
        rig.feed()
        rig.wait(lambda rig=rig: rig.integrated == COUNT, 'all frames')
        rig.worker.stop()
        assert len(list(tmp_path.glob('snapshots/*.ply'))) == wanted


def test_a_folder_that_cannot_be_made_is_named(
    make_worker: Callable[..., Rig], tmp_path: Path,
) -> None:
    (tmp_path / 'file').write_text('')
    rig = make_worker(snapshot_directory=str(tmp_path / 'file' / 'inside'))
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    with pytest.raises(Exception, match='file/inside'):
        rig.worker.saver.snapshot().result(LIMIT)


def test_images_whose_pose_never_comes_are_given_up(make_worker: Callable[..., Rig]) -> None:
    """Also when no more messages arrive; the reason is said once."""
    rig = make_worker(max_wait_for_pose=0.05)
    rig.feed(DEPTH_TOPIC, CAMERA_INFO_TOPIC, '/tf_static')
    rig.wait(lambda: sum(rig.dropped.values()) == COUNT, 'the images to be given up')
    (reason, count), = rig.dropped.items()
    assert count == COUNT
    assert rig.said(f'[{reason}: said once') == 1


@pytest.fixture(scope='module')
def path_along_a_wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a camera that leaves behind what it saw."""
    camera = Camera(48, 36, 45.0, 45.0, 23.5, 17.5)
    path = tmp_path_factory.mktemp('bags') / 'wall'
    record(path, [
        replace(
            plane_view(camera, pose([0, 0, 0], [0.5 * i, 0, 0]), (0, 0, 1), 0.6),
            stamp_ns=1_700_000_000_000_000_000 + i * 100_000_000)
        for i in range(WALL)])
    return path


def test_what_leaves_memory_is_in_the_snapshots_folder(
    make_worker: Callable[..., Rig], path_along_a_wall: Path, tmp_path: Path
) -> None:
    rig = make_worker(bag=path_along_a_wall, max_keyframes=9, depth_max=0.9, queue_size=WALL)
    rig.feed()
    rig.wait(lambda: rig.integrated == WALL, 'all frames')
    rig.wait(lambda: rig.worker.parts.keyframes == WALL - 9, 'those far away to leave')
    rig.wait(lambda: rig.outputs.changed >= set(range(WALL)), 'their meshes to be taken back')
    folder, = tmp_path.glob('snapshots/parts_*')
    assert rig.said(f'finished, each becomes a PLY file in {folder}') == 1
    views = [set(read(path).attributes['view']) for path in sorted(folder.iterdir())]
    assert views == [{number} for number in range(WALL - 9)]
    saved = rig.worker.saver.snapshot().result(LIMIT)
    along = read(saved.file.path).vertices[:, 0]  # half a metre a keyframe, which sees 0.64 m
    assert along.min() == pytest.approx(0.5 * (WALL - 9) - 0.32, abs=0.05)
    assert along.max() == pytest.approx(0.5 * (WALL - 1) + 0.32, abs=0.05)
    assert f'; {WALL - 9} keyframes that left memory are in {folder}: ' in str(saved)
    used, limit = rig.worker.memory
    assert 0 < used < limit
    rig.worker.reset()
    rig.wait(lambda: rig.outputs.cleared, 'the reset')
    rig.feed()
    rig.wait(lambda: rig.integrated == 2 * WALL, 'another map')
    assert len(list(tmp_path.glob('snapshots/parts_*'))) == 2
    rig.worker.stop()
    assert 'keyframes that left memory are in' in rig.worker.summary()


def test_frames_are_refused_where_nothing_can_leave_memory(
    make_worker: Callable[..., Rig], path_along_a_wall: Path, tmp_path: Path
) -> None:
    (tmp_path / 'file').write_text('')
    rig = make_worker(
        bag=path_along_a_wall, max_keyframes=9, depth_max=0.9, queue_size=WALL,
        snapshot_directory=str(tmp_path / 'file' / 'inside'))
    rig.feed()
    rig.wait(lambda: rig.dropped.get('memory') == WALL - 9, 'the others to be refused')
    assert rig.integrated == 9
    assert 'cannot write to' in rig.worker.intake.cameras[''].explanations['memory']
    assert rig.said('[memory: said once, then counted]') == 1


def test_rays_that_wait_are_marched_when_idle(make_worker: Callable[..., Rig]) -> None:
    """Without time for older rays while frames come, the map is complete soon after."""
    rig = make_worker(remarch_budget=0.0, keyframe_translation=0.0)
    rig.feed()
    rig.wait(lambda: rig.integrated == COUNT, 'all frames')
    rig.wait(lambda: rig.worker.waiting_rays == 0, 'the older rays')
