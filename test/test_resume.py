# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t replay --resume`: what a run that was interrupted would have become."""
from collections.abc import Callable
import json
import os
from pathlib import Path
import signal
from typing import Any

import bags_for_tests as bags
import pytest

from gr2t_ros.core.reconstruction import Reconstruction, Update
from gr2t_ros.core.view import View
from gr2t_ros.tools import cli

FRAMES = 8
# with time for older rays it would depend on the machine when they are marched
FIXED = ('-p', 'keyframe_translation:=0.03', '-p', 'remarch_budget:=0.0')
Replay = Callable[..., int]


@pytest.fixture
def replay(tmp_path: Path) -> Replay:
    """Return a function that replays a recording of a wall into a folder."""
    bag = bags.write(tmp_path / 'scan', bags.scan(FRAMES))

    def run(folder: str, *arguments: Any) -> int:
        return cli.main(['replay', str(bag), '-o', str(tmp_path / folder), *map(str, arguments)])

    return run


def test_a_run_in_pieces_is_the_whole_run_bit_for_bit(
    replay: Replay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a planned end, after Ctrl-C, and in a folder of its own or the same."""
    assert replay('whole', '--save-map', *FIXED) == 0
    assert replay('part', '--save-map', '--max-frames', 3, *FIXED) == 0
    add = Reconstruction.add

    def interrupt(self: Reconstruction, view: View, load: float = 0.0) -> Update:
        if self.views == 5:
            os.kill(os.getpid(), signal.SIGINT)
        return add(self, view, load)

    monkeypatch.setattr(Reconstruction, 'add', interrupt)
    assert replay('part', '--save-map', '--resume', tmp_path / 'part') == 130
    monkeypatch.undo()
    assert replay('rest', '--save-map', '--resume', tmp_path / 'part' / 'map.gr2t') == 0
    for name in ('mesh.ply', 'map.gr2t'):
        whole, rest = ((tmp_path / folder / name).read_bytes() for folder in ('whole', 'rest'))
        assert whole == rest, name
    frames = json.loads((tmp_path / 'rest' / 'report.json').read_text())['frames']
    assert frames['read'] == FRAMES
    assert frames['integrated'] == 2 and frames['dropped'] == {'in_map': 6}


@pytest.mark.parametrize(('arguments', 'words'), [
    ((), '8 of 8: not newer than the newest image of the map that it goes on with'),
    (('-p', 'pixel_bandwidth:=2'), 'pixel_bandwidth is 1.5 there and 2.0 here'),
    (('--preset', 'tabletop_scan'), 'depth_bandwidth is 0.003 there and'),
    (('--world-frame', 'camera_link'), "in the world frame 'map', not 'camera_link'"),
])
def test_what_it_cannot_go_on_with(
    replay: Replay, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...], words: str,
) -> None:
    assert replay('whole', '--save-map', *FIXED) == 0
    capsys.readouterr()
    assert replay('rest', '--resume', tmp_path / 'whole', *arguments) == 2
    assert words in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / 'rest' / 'mesh.ply').exists()


def test_other_parameters_may_change(replay: Replay, tmp_path: Path) -> None:
    """Those that are not given are the map's."""
    assert replay('part', '--save-map', '--max-frames', 3, *FIXED) == 0
    assert replay('rest', '--resume', tmp_path / 'part', '-p', 'max_keyframes:=2') == 0
    settings = json.loads((tmp_path / 'rest' / 'report.json').read_text())['settings']
    assert settings['max_keyframes'] == 2 and settings['keyframe_translation'] == 0.03
    assert settings['world_frame'] == 'map'


def test_a_damaged_map(
    replay: Replay, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / 'map.gr2t'
    path.write_bytes(b'gr2t map 1\n')
    assert replay('rest', '--resume', path) == 2
    assert f'cannot use the map {path}: it is truncated' in capsys.readouterr().err
