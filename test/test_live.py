# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A replay can be watched: a picture that is always whole, and a page that shows the newest."""
from pathlib import Path

import bags_for_tests as bags
from browser_for_tests import browser
import cv2
import numpy as np
import pytest
from scenes_for_tests import plane_view, pose

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.settings import Settings
from gr2t_ros.tools import cli, live
from gr2t_ros.tools.live import Live

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


@pytest.fixture
def reconstruction() -> Reconstruction:
    """Return one that is empty and makes each view a keyframe."""
    return Reconstruction(Settings(keyframe_translation=0.0, voxel_size=0.02, threads=1))


def add(reconstruction: Reconstruction, count: int) -> None:
    """Add views of a plane, each somewhat further along it."""
    for i in range(count):
        reconstruction.add(plane_view(
            CAMERA, pose((0, 0, 0), (0.3 * (i + len(reconstruction.keyframes)), 0, 0)),
            (0, 0, 1), 1.0))


def test_pictures_come_now_and_then_and_cost_a_tenth_of_the_time(
    tmp_path: Path, reconstruction: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, cost = [100.0], 1.0
    monkeypatch.setattr(live, 'perf_counter', lambda: now[0])
    drawn: list[float] = []

    def draw(self: Live, title: str) -> None:
        drawn.append(now[0])
        now[0] += cost
    monkeypatch.setattr(Live, '_draw', draw)
    shown = Live(tmp_path, reconstruction)
    shown.reach(1, 1000)
    assert not drawn, 'nothing to draw yet'
    add(reconstruction, 1)
    for done in range(2, 1000):
        now[0] += 0.1
        shown.reach(done, 1000)
    assert len(drawn) * cost == pytest.approx(0.1 * (now[0] - 100.0), rel=0.15)
    cost = 0.001
    begin, before = now[0], len(drawn)
    for done in range(1000):
        now[0] += 0.1
        shown.reach(done, 1000)
    assert len(drawn) - before == pytest.approx((now[0] - begin) / 2.0, abs=6)


def test_the_place_is_kept_until_the_map_has_grown(
    tmp_path: Path, reconstruction: Reconstruction
) -> None:
    shown = Live(tmp_path, reconstruction)
    add(reconstruction, 2)
    shown.reach(2, 10)
    place = shown._T_world_camera
    shown._next = 0.0
    shown.reach(3, 10)
    assert shown._T_world_camera is place
    add(reconstruction, 4)
    shown._next = 0.0
    shown.reach(6, 10)
    assert shown._T_world_camera is not place
    picture = cv2.imread(str(tmp_path / 'preview.png'))
    assert picture.shape == (576, 800, 3)
    assert np.ptp(picture[:500].astype(int), axis=2).max() > 100
    assert sorted(path.name for path in tmp_path.iterdir()) == ['live.html', 'preview.png']


def test_a_replay_says_where_to_look(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'out'
    assert cli.main([
        'replay', str(bags.write(tmp_path / 'scan', bags.scan(4))), '-o', str(out), '--live',
        '-p', 'threads:=1']) == 0
    assert f'open {out / "live.html"} in a browser' in capsys.readouterr().err
    assert (out / 'preview.png').stat().st_size > 0


def test_the_page_shows_the_newest_picture(
    tmp_path: Path, reconstruction: Reconstruction
) -> None:
    Live(tmp_path, reconstruction)
    with browser() as page:
        cv2.imwrite(str(tmp_path / 'preview.png'), np.full((60, 90, 3), (0, 0, 200), np.uint8))
        page.go(tmp_path / 'live.html')
        page.until("document.querySelector('img').naturalWidth === 90")
        assert page.picture()[200, 450].tolist() == [200, 0, 0]
        cv2.imwrite(str(tmp_path / 'preview.png'), np.full((80, 120, 3), (0, 200, 0), np.uint8))
        page.until("document.querySelector('img').naturalWidth === 120")
        assert page.picture()[200, 450].tolist() == [0, 200, 0]
        assert page.errors == []
