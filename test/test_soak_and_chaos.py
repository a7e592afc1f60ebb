# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Short forms of make soak and make chaos."""
import os
from pathlib import Path
import re
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')
pytest.importorskip('tf2_msgs', reason='tf2_msgs is not installed')

PROJECT = Path(__file__).resolve().parents[1]
LIMIT = 1200.0  # s: kernels may have to be compiled, beside other work


def run(name: str, *arguments: str) -> str:
    """Run a benchmark; return what it prints."""
    path = os.pathsep.join([str(PROJECT), os.environ.get('PYTHONPATH', '')])
    with subprocess.Popen(
            [sys.executable, str(PROJECT / 'benchmarks' / name), *arguments], text=True,
            env={**os.environ, 'PYTHONPATH': path}, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT) as process:
        try:
            said, _ = process.communicate(timeout=LIMIT)
        except BaseException:
            process.send_signal(signal.SIGINT)  # it ends the node that it started
            raise
    assert process.returncode == 0, said
    return said


def test_a_short_soak() -> None:
    """Keyframes leave memory, and all that left is on the disk."""
    said = run(
        'soak.py', '--minutes', '0.15', '--memory', '24', '--size', '160', '120', '--speed', '1')
    keyframes, left, parts = map(int, re.search(
        r'left memory / parts on the disk +(\d+) / (\d+) / (\d+)', said).groups())
    assert 0 < left == parts < keyframes
    assert re.search(r'received, but not accounted for +0 ', said)


def test_a_little_chaos() -> None:
    """Whatever is injected, the node survives, and nothing that was acknowledged is lost."""
    faults = ('publisher_killed', 'tf_stops', 'clock_goes_back', 'all_frames_fail', 'disk_full')
    said = run('chaos.py', '--times', '1', '--only', *faults)
    for fault in faults:
        assert f'{fault}: survived 1 of 1, lost 0' in said
