# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A short form of benchmarks/kill.py: whatever moment a writer is killed at, files are whole."""
import os
from pathlib import Path
import re
import subprocess
import sys

PROJECT = Path(__file__).resolve().parents[1]
LIMIT = 300.0  # s: for what takes twenty on a machine that does nothing else


def test_a_few_kills() -> None:
    path = os.pathsep.join([str(PROJECT), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        [sys.executable, str(PROJECT / 'benchmarks' / 'kill.py'), '--kills', '15', '--nodes', '0'],
        env={**os.environ, 'PYTHONPATH': path}, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stdout
    kills, _, read, *wrong = map(int, re.search(
        r'^writers' + r' +(\d+)' * 6, done.stdout, re.M).groups())
    assert kills == 15 and read > 0 and wrong == [0, 0, 0], done.stdout
