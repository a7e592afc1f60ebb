# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What gr2t_node does with three times as many images as it can integrate.

    python benchmarks/overload.py [--seconds 30]

Images of 640 x 480 pixels come over DDS: first as fast as 30 Hz, to see how many come into the
map; then three times as many; then none. Services are called all the while. Writes
benchmarks/results/overload.json; exit code 1 where an image is not accounted for.
"""
from __future__ import annotations

import argparse
from contextlib import closing
import json
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

from common import machine, table
import numpy as np
from rig import Rig
from std_srvs.srv import SetBool, Trigger
from synthetic_camera import render

_PROJECT = Path(__file__).resolve().parents[1]
_SIZE = (640, 480)
_FASTEST = 30.0  # Hz
_TIMES = 3.0
_SETTINGS = {'depth_max': 3.0}  # otherwise the defaults: h3 and voxels of 7.5 mm at 1.5 m
_QUEUE = 10  # queue_size
_ANSWER = 0.5  # s
_SERVICES = (
    (Trigger, 'timing', {}), (SetBool, 'pause', {'data': False}))


def measure(rig: Rig, name: str, seconds: float) -> dict[str, Any]:
    """Call services for some time; return what came of the images, and how long answers took."""
    rig.flows(1)
    before, dropped = rig.values(), rig.dropped()
    began = time.monotonic()
    waits: list[float] = []
    latencies: list[float] = []
    while time.monotonic() < began + seconds:
        for kind, service, fields in _SERVICES:
            asked = time.monotonic()
            rig.call(kind, service, **fields)
            waits.append(time.monotonic() - asked)
        rig.spin(0.3)
        latencies.append(float(rig.values().get('stamp to publish p95 (ms)', 'nan')))
    rig.flows(1)
    after, elapsed = rig.values(), time.monotonic() - began
    received, integrated = (
        int(after[key]) - int(before[key]) for key in ('received', 'integrated'))
    return {
        'images': name, 'received Hz': received / elapsed, 'integrated Hz': integrated / elapsed,
        'dropped': rig.dropped() - dropped, 'latency p95, ms': float(np.nanmedian(latencies)),
        'worst': float(np.nanmax(latencies)), 'answers p95, ms': 1e3 * float(
            np.percentile(waits, 95)), 'slowest answer': 1e3 * max(waits)}


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=30.0, help='each')
    arguments = parser.parse_args()
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, load average {about["load"]:.1f}',
          flush=True)
    with tempfile.TemporaryDirectory(prefix='gr2t_overload_') as name:
        folder = Path(name)
        render(folder / 'frames.npy', *_SIZE)
        with closing(Rig(
                folder, folder / 'frames.npy', _SETTINGS,
                ('--rate', f'{_FASTEST}'))) as rig:
            rig.listen_to_meshes()
            rig.flows(10)
            rows = [measure(rig, f'{_FASTEST:g} Hz', arguments.seconds)]
            capacity = rows[0]['integrated Hz']
            rate = _TIMES * capacity
            rig.camera.tell(f'rate {rate}')
            rows.append(measure(rig, f'{_TIMES:g} x {capacity:.1f} Hz', arguments.seconds))
            waiting = rig.count('waiting rays')
            rig.camera.end()
            ended = time.monotonic()
            lost = rig.unaccounted()
            rig.wait(lambda: rig.count('waiting rays') == 0, 'the backlog')
            backlog = time.monotonic() - ended
            values = rig.values()
    table('Images of 640 x 480 pixels, default parameters', rows)
    bound = 1e3 * (_QUEUE + 2) / capacity + 1e3 / 2
    print(
        f'\nbound of the latency: ({_QUEUE} + 2) / {capacity:.1f} Hz + 0.5 s = {bound:.0f} ms'
        f'\nanswers, target: {1e3 * _ANSWER:.0f} ms'
        f'\nafter the last image {waiting} rays wait to be looked at; all done after '
        f'{backlog:.1f} s'
        f'\nreceived {values["received"]}, integrated {values["integrated"]}, dropped: '
        + ', '.join(f'{key[9:]} {value}' for key, value in values.items()
                    if key.startswith('dropped: ')) + f'; not accounted for: {lost}')
    results = _PROJECT / 'benchmarks' / 'results'
    results.mkdir(exist_ok=True)
    with open(results / 'overload.json', 'w', encoding='utf-8') as file:
        json.dump({'machine': about, 'rows': rows, 'waiting': waiting, 'backlog': backlog,
                   'lost': lost}, file, indent=1)
    return 1 if lost else 0


if __name__ == '__main__':
    sys.exit(main())
