# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`make demo`, on a scene of few and small images."""
from pathlib import Path
import signal
import subprocess

import cv2
import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')
pytest.importorskip('tf2_msgs', reason='tf2_msgs is not installed')
pytest.importorskip('embreex', reason='the ray caster embreex is not installed')

from ros_for_tests import Isolation, LIMIT, wait_until

from gr2t_ros.io.formats import read
from gr2t_ros.ros.isolation import isolated
from gr2t_ros.tools import demo


def test_it_leaves_a_mesh_and_a_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, value in isolated({}).items():
        monkeypatch.setenv(name, value)  # the demo sets these in this process: undone later
    for name, number in (('VIEWS', 4), ('WIDTH', 96), ('HEIGHT', 72), ('RATE', 10.0)):
        monkeypatch.setattr(demo, name, number)
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    try:
        assert demo.main(['-o', str(tmp_path / 'results')]) == 0
    finally:
        for number, handler in zip((signal.SIGINT, signal.SIGTERM), handlers):
            signal.signal(number, handler)
    assert len(read(tmp_path / 'results' / 'mesh.ply').faces) > 1000
    assert cv2.imread(str(tmp_path / 'results' / 'preview.png')) is not None
    output = capfd.readouterr().out
    assert 'distance to the true surface: mean' in output
    assert 'frames: 4 received, 4 integrated, 0 dropped' in output
    assert 'seconds: simulate' in output


def test_an_interrupt_ends_all_processes(tmp_path: Path) -> None:
    with open(tmp_path / 'output', 'w') as output:
        process = Isolation().run(
            'gr2t_ros.tools.demo', '-o', tmp_path, stdout=output, stderr=subprocess.STDOUT)
    try:
        wait_until(lambda: '[3/6]' in (tmp_path / 'output').read_text(), 'the player',
                   5 * LIMIT)
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT) == 130
    finally:
        process.kill()
        process.wait()
    assert 'frames: ' in (tmp_path / 'gr2t_node.log').read_text(), 'the node has ended'
    assert 'Traceback' not in (tmp_path / 'output').read_text()
