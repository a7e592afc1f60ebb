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
from collections.abc import Callable, Sequence
from contextlib import closing
import json
import os
from pathlib import Path
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from common import machine, table
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import rclpy
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool, Trigger
from synthetic_camera import render, SyntheticCamera

from gr2t_ros.errors import InputError
from gr2t_ros.io import formats
from gr2t_ros.ros.isolation import isolated

_PROJECT = Path(__file__).resolve().parents[1]
_PATIENCE = 120.0  # s: for what takes a few on a machine that does nothing else
_SIZE = (160, 120)  # pixels
_FRAMES = 60
_RATE, _FLOOD = 15.0, 400.0  # Hz
_SETTINGS = {
    'voxel_size': 0.04, 'depth_bandwidth': 0.02, 'max_memory_mb': 25, 'publish_rate': 10.0,
    'max_wait_for_pose': 0.3}
_PARTS = re.compile(r'(\d+) keyframes that left memory are in (.*?): ')
_LAST = 30  # diagnostics within which the last images are accounted for
_FULL = 100_000  # bytes that a file may have on the full disk
# runs the node; its frames fail while a file exists: all, or those that it names by their number
_FAILING = """
import itertools, pathlib, sys
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.ros.node import main
add, count = Reconstruction.add, itertools.count()
def failing(self, *arguments):
    flag = pathlib.Path(sys.argv[1])
    if flag.exists() and next(count) % int(flag.read_text() or 1) == 0:
        raise ZeroDivisionError('injected')
    return add(self, *arguments)
Reconstruction.add = failing
sys.exit(main(sys.argv[:1] + sys.argv[2:]))
"""


class Rig:
    """
    A running node, a camera, and what the node says.

    acknowledged: snapshots that were answered with success.

    :param folder: for snapshots and logs
    :param frames: of synthetic_camera.render
    """

    def __init__(self, folder: Path, frames: Path) -> None:
        self.folder, self.frames = folder, frames
        self.snapshots = folder / 'snapshots'
        self.flag = folder / 'fail'
        self.environment = isolated(os.environ)
        os.environ.update(self.environment)
        rclpy.init(args=[])
        self._node = rclpy.create_node('chaos')
        self._states: list[bytes] = []
        self._node.create_subscription(
            DiagnosticArray, '/diagnostics', self._note, 10, raw=True)
        self.acknowledged: list[Path] = []
        self._parts: dict[Path, int] = {}  # folder -> keyframes that it holds at least
        self.place = 0.0
        self.process = self.start_node('gr2t')
        self.camera = self.start_camera()

    def start_node(self, name: str) -> subprocess.Popen[bytes]:
        """Start a node of this name, with the same folder for snapshots."""
        log = self.folder / f'{name}.log'
        arguments = [item for key, value in {
            **_SETTINGS, 'snapshot_directory': self.snapshots}.items()
            for item in ('-p', f'{key}:={value}')]
        with open(log, 'ab') as file:
            began = file.tell()
            process = subprocess.Popen(
                [sys.executable, '-c', _FAILING, str(self.flag), '--ros-args', '-r',
                 f'__node:={name}', *arguments],
                stdout=file, stderr=file, env=self.environment, start_new_session=True)
        self.wait(
            lambda: b'subscribed to' in log.read_bytes()[began:] or process.poll() is not None,
            f'{name} to subscribe')
        return process

    def start_camera(self) -> SyntheticCamera:
        """Start a camera where the last one ended."""
        self.place += 0.5
        return SyntheticCamera(
            self.frames, '--rate', f'{_RATE}', '--speed', '0.5', '--start', f'{self.place}',
            environment=self.environment)

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        """Serve callbacks until a condition is true; return its value."""
        end = time.monotonic() + _PATIENCE
        while not (value := condition()):
            if time.monotonic() > end:
                raise TimeoutError(f'waited in vain for {what}')
            rclpy.spin_once(self._node, timeout_sec=0.05)
        return value

    def spin(self, seconds: float) -> None:
        """Serve callbacks for some time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def values(self) -> dict[str, str]:
        """Return what the node's newest diagnostics hold."""
        return {
            item.key: item.value for status in self.statuses() for item in status.values}

    def statuses(self) -> list[DiagnosticStatus]:
        """Return the node's newest diagnostics."""
        return list(deserialize_message(self._states[-1], DiagnosticArray).status
                    ) if self._states else []

    def count(self, key: str) -> int:
        """Return a number of the newest diagnostics, 0 where it is not there."""
        return int(float(self.values().get(key, 0)))

    def flows(self, more: int = 3) -> None:
        """Wait until more images have come into the map."""
        self._states.clear()
        self.wait(lambda: self._states, 'diagnostics')
        before = self.count('integrated')
        self.wait(lambda: self.count('integrated') >= before + more, 'images in the map')

    def dropped(self) -> int:
        """Return the number of images that were dropped."""
        return sum(int(value) for key, value in self.values().items()
                   if key.startswith('dropped: '))

    def call(self, kind: Any, service: str, node: str = 'gr2t', **fields: Any) -> Any:
        """Return a service's answer; None where the node ends before."""
        client = self._node.create_client(kind, f'/{node}/{service}')
        try:
            self.wait(client.service_is_ready, f'the service {service}')
            answer = client.call_async(kind.Request(**fields))
            process = self.process
            self.wait(lambda: answer.done() or process.poll() is not None, service)
            return answer.result() if answer.done() else None
        finally:
            self._node.destroy_client(client)

    def snapshot(self, node: str = 'gr2t') -> bool:
        """Ask for a snapshot; remember it where it was acknowledged."""
        return self.note(self.call(Trigger, 'save_snapshot', node))

    def note(self, answer: Any) -> bool:
        """Remember a snapshot that was acknowledged, and what it says of parts."""
        if answer is not None and answer.success:
            self.acknowledged.append(Path(answer.message.partition(': ')[0]))
            if found := _PARTS.search(answer.message):
                folder = Path(found[2])
                self._parts[folder] = max(int(found[1]), self._parts.get(folder, 0))
        return bool(answer is not None and answer.success)

    def together(self, names: Sequence[str]) -> list[Any]:
        """Return the answers of several nodes that are asked for a snapshot at once."""
        clients = [self._node.create_client(Trigger, f'/{name}/save_snapshot') for name in names]
        for client in clients:
            self.wait(client.service_is_ready, 'the service')
        answers = [client.call_async(Trigger.Request()) for client in clients]
        for answer in answers:
            self.wait(answer.done, 'a snapshot')
        for client in clients:
            self._node.destroy_client(client)
        return [answer.result() for answer in answers]

    def lost(self) -> int:
        """Count what was acknowledged and is not there; damaged files too."""
        self.snapshot()
        self.camera.end()
        for _ in range(_LAST):  # the worker may have some in its hands
            self._states.clear()
            self.wait(lambda: self._states, 'diagnostics')
            unaccounted = self.count('received') - self.count('integrated') - self.dropped()
            if not unaccounted:
                break
        missing = sum(not _whole(path) for path in self.acknowledged)
        missing += sum(
            max(count - len(list(folder.glob('[!.]*.ply'))), 0)
            for folder, count in self._parts.items())
        twice = len(self.acknowledged) - len(set(self.acknowledged))
        damaged = sum(not _whole(path) for path in self.snapshots.rglob('[!.]*.ply'))
        self.camera = self.start_camera()
        return abs(unaccounted) + missing + twice + damaged

    def parts(self) -> int:
        """Return the number of keyframes that left memory and are on the disk."""
        return len(list(self.snapshots.glob('parts_*/[!.]*.ply')))

    def close(self) -> None:
        """End all."""
        if self.camera.alive:
            self.camera.kill()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(timeout=60)
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _note(self, data: bytes) -> None:
        # another node's diagnostics are not this one's
        if b'gr2t: map' in data:
            self._states.append(data)


def _whole(path: Path) -> bool:
    try:
        formats.read(path)
    except InputError as error:
        return 'no triangles' in str(error)  # of an empty mesh
    return True


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
    client = rig._node.create_client(Trigger, '/gr2t/save_snapshot')
    rig.wait(client.service_is_ready, 'the service')
    answer = client.call_async(Trigger.Request())
    rig.spin(0.3 * random.random())
    rig.process.kill()
    rig.process.wait()
    rig.spin(0.2)
    if answer.done():
        rig.note(answer.result())
    rig._node.destroy_client(client)
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
        with closing(Rig(folder, folder / 'frames.npy')) as rig:
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
