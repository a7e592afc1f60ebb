# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A recording becomes a mesh, a picture and a report, whatever happens on the way."""
from collections.abc import Callable
import json
import os
from pathlib import Path
import signal
from typing import Any

import bags_for_tests as bags
from bags_for_tests import DEPTH
import cv2
import numpy as np
import pytest

from gr2t_ros.core.reconstruction import Reconstruction, Update
from gr2t_ros.core.view import View
from gr2t_ros.io import formats, trajectory
from gr2t_ros.tools import cli

FEW = ('-p', 'keyframe_translation:=0.03', '-p', 'threads:=1')


def replay(*arguments: Any) -> int:
    """Run the command."""
    return cli.main(['replay', *map(str, arguments), *FEW])


def report(directory: Path) -> Any:
    """Return a run's report."""
    return json.loads((directory / 'report.json').read_text())


def test_a_scan_becomes_mesh_picture_and_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert replay(bags.write(tmp_path / 'scan', bags.scan(6)), '--per-view') == 0
    out = tmp_path / 'scan_gr2t'  # where no folder is named
    mesh = formats.read(out / 'mesh.ply')
    # a wall with 2 mm of noise, a metre away; the camera moves 2 cm a frame
    assert np.abs(mesh.vertices[:, 2] - 1).mean() < 0.001
    assert len(mesh.faces) > 1000
    assert mesh.attributes['views'].max() == 3
    found = report(out)
    assert found['frames'] == {'read': 6, 'integrated': 6, 'keyframes': 3, 'dropped': {}}
    assert found['mesh'] == {'vertices': len(mesh.vertices), 'faces': len(mesh.faces)}
    assert found['likelihood']['max'] == mesh.attributes['likelihood'].max()
    assert found['rays']['marched'] == 3 * bags.WIDTH * bags.HEIGHT
    assert found['settings']['world_frame'] == 'map'
    assert found['input_damage'] == ''
    # the wall goes on beyond the images
    for view in found['next_views']:
        assert view['viewpoint']['position'][2] < view['position'][2] < 1.05
    assert found['next_views']
    views = sorted((out / 'views').iterdir())
    assert [path.name for path in views] == ['view_0000.ply', 'view_0001.ply', 'view_0002.ply']
    for number, path in enumerate(views):
        part = formats.read(path)
        assert set(part.attributes['view']) == {number}
        assert np.abs(part.vertices[:, 2] - 1).mean() < 0.001
    stamps, _ = trajectory.read(out / 'cameras.txt')
    assert stamps == [bags.stamp(i) for i in (0, 2, 4)]
    assert cv2.imread(str(out / 'preview.png')).std() > 10
    printed = capsys.readouterr()
    for name in ('mesh.ply', 'preview.png', 'report.json', 'views'):
        assert f'scan_gr2t/{name}' in printed.out
    assert f'{DEPTH} (6 images; rectified' in printed.err
    assert 'keyframe_translation:=0.03' in printed.err


def test_bad_frames_are_counted_and_the_rest_still_reconstruct(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shape = (bags.HEIGHT, bags.WIDTH)
    others = {
        1: bags.image(1, data=np.zeros(shape, np.uint16)),
        2: bags.image(2, data=np.ones(shape, np.uint8), encoding='8UC1'),
        3: bags.image(3, data=np.full((8, 8), 1000, np.uint16)),
        4: bags.image(4, data=np.ones(shape, np.uint16)),
        20: bags.image(20)}
    messages = [message for message in bags.scan(6)
                if not (message.topic == DEPTH
                        and message.log_ns in {other.log_ns for other in others.values()})]
    assert replay(bags.write(tmp_path / 'scan', [*messages, *others.values()]),
                  '-o', tmp_path / 'out') == 0
    frames = report(tmp_path / 'out')['frames']
    assert (frames['read'], frames['integrated']) == (7, 2)
    assert sum(frames['dropped'].values()) == 5
    assert frames['dropped'].items() >= {
        'no_valid_depth': 1, 'encoding': 1, 'image_size': 1, 'depth_unit': 1}.items()
    out = capsys.readouterr().out
    assert "dropped  1 encoding: depth image has encoding '8UC1'" in out
    assert len(formats.read(tmp_path / 'out' / 'mesh.ply').faces) > 500


def test_start_and_max_frames_choose_a_part(tmp_path: Path) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan(8))
    assert replay(path, '-o', tmp_path / 'out', '--start', 0.3, '--max-frames', 2) == 0
    assert report(tmp_path / 'out')['frames']['integrated'] == 2
    # the camera's way begins where it was at the fourth image
    mesh = formats.read(tmp_path / 'out' / 'mesh.ply')
    assert mesh.vertices[:, 0].min() > 0.02 * 3 - 0.55


def test_a_start_after_the_end_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bags.write(tmp_path / 'scan', bags.scan(3))
    assert replay(path, '-o', tmp_path / 'out', '--start', 9) == 2
    assert '--start 9 s is after the end of' in capsys.readouterr().err


def during_frame(
    number: int, action: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Let something happen while the frame of a number is added."""
    add, count = Reconstruction.add, iter(range(1000))

    def adds(self: Reconstruction, view: View) -> Update:
        if next(count) == number + 2:  # two are added to warm up
            action()
        return add(self, view)
    monkeypatch.setattr(Reconstruction, 'add', adds)


def test_an_interrupt_saves_what_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    during_frame(3, lambda: os.kill(os.getpid(), signal.SIGINT), monkeypatch)
    before = signal.getsignal(signal.SIGINT)
    assert replay(bags.write(tmp_path / 'scan', bags.scan(8)), '-o', tmp_path / 'out') == 130
    assert signal.getsignal(signal.SIGINT) is before
    frames = report(tmp_path / 'out')['frames']
    assert (frames['read'], frames['integrated']) == (4, 4)
    assert len(formats.read(tmp_path / 'out' / 'mesh.ply').faces) > 500
    assert 'stopping after this frame' in capsys.readouterr().err


def test_a_second_interrupt_is_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def twice() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
    during_frame(3, twice, monkeypatch)
    assert replay(bags.write(tmp_path / 'scan', bags.scan(8)), '-o', tmp_path / 'out') == 130
    assert not list((tmp_path / 'out').iterdir())


def test_a_failure_midway_keeps_what_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise RuntimeError('out of order')
    during_frame(3, fail, monkeypatch)
    assert replay(bags.write(tmp_path / 'scan', bags.scan(8)), '-o', tmp_path / 'out') == 1
    assert report(tmp_path / 'out')['frames']['integrated'] == 3
    assert capsys.readouterr().err.splitlines()[-1] == (
        'gr2t: unexpected RuntimeError: out of order (--debug shows where)')


def test_of_a_damaged_recording_all_that_reads_is_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = np.random.default_rng(0).integers(0, 1000, (240, 320), np.uint16)
    messages = [*bags.scan(20),
                *(bags.image(i, '/camera/aligned/image', large) for i in range(20))]
    path = bags.write(tmp_path / 'scan', messages, 'rosbag1 bz2')
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle:middle + 100] = bytes(100)
    path.write_bytes(content)
    assert replay(path, '-o', tmp_path / 'out') == 0
    found = report(tmp_path / 'out')
    assert 0 < found['frames']['integrated'] < 20
    assert f'{path} is damaged (Invalid data stream): ' in found['input_damage']
    assert ' bytes are damaged or lost: from byte ' in found['input_damage']
    assert 'damage   ' in capsys.readouterr().out


def test_the_kitchen_needs_no_option_but_patience(data: Path, tmp_path: Path) -> None:
    assert cli.main([
        'replay', str(data / 'bags' / 'kitchen_sweep'), '-o', str(tmp_path / 'out'),
        '--max-frames', '4', '-p', 'ray_stride:=8']) == 0
    found = report(tmp_path / 'out')
    assert found['frames']['integrated'] == 4
    assert found['frames']['dropped'] == {}
    assert found['settings']['world_frame'] == 'map'
    vertices = formats.read(tmp_path / 'out' / 'mesh.ply').vertices
    assert len(vertices) > 1000
    assert np.all(np.ptp(vertices, axis=0) < 10)  # a room


def test_what_does_not_fit_into_memory_is_on_the_disk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The parts and the rest are all keyframes; no frame is dropped; a former run's parts go."""
    bag = bags.write(tmp_path / 'scan', bags.scan(60))
    out = tmp_path / 'out'
    assert replay(
        bag, '-o', out, '--per-view', '-p', 'max_memory_mb:=3', '-p', 'voxel_size:=0.02') == 0
    found, printed = report(out), capsys.readouterr()
    assert found['frames']['dropped'] == {}
    parts = sorted((out / 'parts').iterdir())
    left = found['parts']['keyframes']
    assert 0 < left == len(parts) < found['frames']['keyframes']
    meshes = [formats.read(path) for path in parts]
    rest = formats.read(out / 'mesh.ply')
    assert sum(len(mesh.faces) for mesh in meshes) == found['parts']['faces'] > 0
    views = {int(number) for mesh in meshes for number in set(mesh.attributes['view'])}
    kept = [int(path.stem[-4:]) for path in (out / 'views').iterdir()]
    assert sorted([*views, *kept]) == list(range(found['frames']['keyframes']))
    for mesh in [*meshes, rest]:
        assert np.abs(mesh.vertices[:, 2] - 1).mean() < 0.002
    assert f'go to {out / "parts"}, a PLY file each' in printed.err
    assert f'of the {len(kept)} keyframes still in memory' in printed.out
    assert f'the other {left} keyframes, finished, a file each' in printed.out
    assert replay(bag, '-o', out) == 0
    assert list((out / 'parts').iterdir()) == []


def test_a_bound_that_no_map_fits_into_ends_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = bags.write(tmp_path / 'scan', bags.scan(6))
    assert replay(bag, '-o', tmp_path / 'out', '-p', 'max_memory_mb:=1') == 1
    assert 'max_memory_mb allows 1: raise it' in capsys.readouterr().err
    assert len(formats.read(tmp_path / 'out' / 'mesh.ply').faces) > 0, 'what was done is kept'
