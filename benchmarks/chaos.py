# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What goes wrong around a running gr2t_node, and what is lost by it.

    python benchmarks/chaos.py [--times 10] [--only WORD ...]

Each fault is injected some times into a node that is fed over DDS. It survived where the node runs
on, and images come into the map again. Lost is what was acknowledged and is not there: snapshots
that were answered with success, keyframes that left memory, images that were received and neither
are in the map nor counted as dropped. Writes benchmarks/results/chaos.json; exit code 1 where
something was lost, or the node did not survive.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import closing
import json
from pathlib import Path
import random
import resource
import signal
import sys
import tempfile
import time
from typing import Any

from common import machine, table
from diagnostic_msgs.msg import DiagnosticStatus
from rig import Rig
from std_srvs.srv import SetBool, Trigger
from synthetic_camera import render

_PROJECT = Path(__file__).resolve().parents[1]
_SIZE = (160, 120)  # pixels
_FRAMES = 60
_RATE, _FLOOD = 15.0, 400.0  # Hz
_SETTINGS = {
    'voxel_size': 0.04, 'depth_bandwidth': 0.02, 'max_memory_mb': 25, 'publish_rate': 10.0,
    'max_wait_for_pose': 0.3}
_FULL = 100_000  # bytes that a file may have on the full disk


def publisher_killed(rig: Rig) -> None:
    """Kill the camera's process, and start it again."""
    rig.camera.kill()
    rig.spin(random.random())
    rig.camera = rig.start_camera()
    rig.flows()


def tf_stops(rig: Rig) -> None:
    """Stop tf for a while, not the images."""
    rig.camera.tell('tf off')
    before = rig.dropped()
    rig.wait(lambda: rig.dropped() > before + 2, 'images to be given up')
    rig.camera.tell('tf on')
    rig.flows()


def images_stop(rig: Rig) -> None:
    """Stop the images for a while, not tf."""
    rig.camera.tell('images off')
    rig.spin(1.0)
    rig.camera.tell('images on')
    rig.flows()


def clock_goes_back(rig: Rig) -> None:
    """Set the clock back by half a minute, and forth again."""
    for shift in (-30, 0):
        rig.camera.tell(f'clock {shift}')
        rig.flows()


def clock_goes_forth(rig: Rig) -> None:
    """Set the clock forth by an hour, and back again."""
    for shift in (3600, 0):
        rig.camera.tell(f'clock {shift}')
        rig.flows()


def camera_jumps(rig: Rig) -> None:
    """Have the camera 30 m away from one image to the next, and back."""
    for place in (30, 0):
        rig.camera.tell(f'jump {place}')
        rig.flows()


def damaged_images(rig: Rig) -> None:
    """Send six kinds of images that cannot be used."""
    before = rig.dropped()
    rig.camera.tell('bad 6')
    rig.wait(lambda: rig.dropped() >= before + 6, 'the damaged images to be counted')
    rig.flows()


def wrong_numbers(rig: Rig) -> None:
    """Send calibrations and poses that are no numbers."""
    reasons = ('dropped: uncalibrated', 'dropped: bad_pose')
    before = [rig.count(reason) for reason in reasons]
    rig.camera.tell('wrong 8')
    rig.wait(lambda: all(rig.count(reason) > count for reason, count in zip(reasons, before)),
             'the images to be counted')
    rig.flows()


def frames_fail(rig: Rig) -> None:
    """Have the computation of every third frame fail."""
    before = rig.count('dropped: error')
    rig.flag.write_text('3')
    rig.wait(lambda: rig.count('dropped: error') > before + 1, 'frames that fail')
    rig.flows()
    rig.flag.unlink()
    rig.flows()


def all_frames_fail(rig: Rig) -> None:
    """Have all frames fail for a while: the diagnostics are at ERROR then, and only then."""
    def wrong() -> bool:
        return any(status.level == DiagnosticStatus.ERROR and 'fail' in status.message
                   for status in rig.statuses())

    rig.flag.write_text('1')
    rig.wait(wrong, 'an ERROR')
    rig.flag.unlink()
    rig.flows()
    rig.wait(lambda: not wrong(), 'no ERROR')


def disk_full(rig: Rig) -> None:
    """Have a full disk: snapshots are refused, keyframes stay in memory."""
    pid = rig.process.pid
    rig.flows()
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (_FULL, resource.RLIM_INFINITY))
    try:
        if rig.snapshot():
            raise AssertionError('a snapshot on a full disk was acknowledged')
        rig.wait(lambda: 'dropped: memory' in rig.values(), 'memory to be full')
    finally:
        resource.prlimit(
            pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    rig.flows()


def folder_vanishes(rig: Rig) -> None:
    """Take the folder of the snapshots away: snapshots are refused."""
    away = rig.folder / 'away'
    rig.snapshot()
    rig.snapshots.rename(away)
    rig.snapshots.write_text('')
    try:
        if rig.snapshot():
            raise AssertionError('a snapshot into no folder was acknowledged')
    finally:
        rig.snapshots.unlink()
        away.rename(rig.snapshots)
    rig.flows()


def two_nodes(rig: Rig) -> None:
    """Have two nodes save snapshots into one folder at the same time."""
    rig.flows()
    other = rig.start_node('other')
    try:
        names = ('gr2t', 'other')
        rig.wait(lambda: rig.snapshot('other'), 'the other node\'s map')
        for _ in range(3):
            for answer in rig.together(names):
                rig.note(answer)
    finally:
        other.send_signal(signal.SIGINT)
        other.wait(timeout=60)
    rig.flows()


def node_killed(rig: Rig) -> None:
    """Kill the node while it saves a snapshot, and start it again."""
    rig.flows()
    def kill() -> None:
        rig.spin(0.3 * random.random())
        rig.process.kill()
        rig.process.wait()

    rig.note(rig.call(Trigger, 'save_snapshot', meanwhile=kill))
    rig.process = rig.start_node('gr2t')
    rig.flows()


def overload(rig: Rig) -> None:
    """Send images much faster than they can be integrated."""
    before = rig.count('dropped: queue_full')
    rig.camera.tell(f'rate {_FLOOD}')
    rig.wait(lambda: rig.count('dropped: queue_full') > before + 10, 'images to be left out')
    for kind, service, fields in (
            (Trigger, 'timing', {}), (SetBool, 'pause', {'data': False}),
            (Trigger, 'save_snapshot', {})):
        began = time.monotonic()
        rig.call(kind, service, **fields)
        WAITS.setdefault(service, []).append(time.monotonic() - began)
    rig.camera.tell(f'rate {_RATE}')
    rig.flows()
    rig.camera.tell('images off')
    rig.wait(lambda: rig.count('waiting rays') == 0, 'the backlog')
    rig.camera.tell('images on')


FAULTS: tuple[Callable[[Rig], None], ...] = (
    publisher_killed, tf_stops, images_stop, clock_goes_back, clock_goes_forth, camera_jumps,
    damaged_images, wrong_numbers, frames_fail, all_frames_fail, disk_full, folder_vanishes,
    two_nodes, overload, node_killed)
WAITS: dict[str, list[float]] = {}  # s for answers while there is too much to do


def inject(rig: Rig, fault: Callable[[Rig], None], times: int) -> dict[str, Any]:
    """Inject a fault some times; return a row of the table."""
    survived, why = 0, ''
    for _ in range(times):
        try:
            fault(rig)
        except (TimeoutError, AssertionError) as error:
            why = str(error)
        else:
            survived += rig.process.poll() is None
        if rig.process.poll() is not None:
            rig.process = rig.start_node('gr2t')
        if not rig.camera.alive:
            rig.camera = rig.start_camera()
    lost = rig.lost()
    if why:
        print(f'{fault.__name__}: {why}', flush=True)
    return {
        'fault': (fault.__doc__ or '').strip(' .'), 'times': times, 'survived': survived,
        'lost': lost}


def main() -> int:
    """Inject all faults."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--times', type=int, default=10, help='each fault')
    parser.add_argument(
        '--only', nargs='*', default=[''], metavar='WORD', help='faults with one in their name')
    arguments = parser.parse_args()
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, load average {about["load"]:.1f}',
          flush=True)
    rows = []
    with tempfile.TemporaryDirectory(prefix='gr2t_chaos_') as name:
        folder = Path(name)
        render(folder / 'frames.npy', *_SIZE, _FRAMES)
        with closing(Rig(
                folder, folder / 'frames.npy', _SETTINGS,
                ('--rate', f'{_RATE}', '--speed', '0.5'))) as rig:
            rig.flows()
            for fault in FAULTS:
                if any(word in fault.__name__ for word in arguments.only):
                    rows.append(inject(rig, fault, arguments.times))
                    print(f'{fault.__name__}: survived {rows[-1]["survived"]} of '
                          f'{arguments.times}, lost {rows[-1]["lost"]}', flush=True)
            snapshots, parts = len(rig.acknowledged), rig.parts()
    table('Faults', rows)
    print(f'\n{snapshots} snapshots were acknowledged, {parts} keyframes left memory')
    for service, waits in WAITS.items():
        print(f'{service} under overload: {1000 * max(waits):.0f} ms at most')
    results = _PROJECT / 'benchmarks' / 'results'
    results.mkdir(exist_ok=True)
    with open(results / 'chaos.json', 'w', encoding='utf-8') as file:
        json.dump({'machine': about, 'faults': rows, 'answers': WAITS}, file, indent=1)
    return 0 if all(
        row['lost'] == 0 and row['survived'] == row['times'] for row in rows) else 1


if __name__ == '__main__':
    sys.exit(main())
