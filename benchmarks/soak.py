# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether gr2t_node goes on as it began: memory, the cost of a frame, leaks.

    python benchmarks/soak.py [--minutes 20] [--memory 500]

A camera of 640 x 480 pixels moves 10 m a minute along a wall, 30 images a second over DDS, while
someone listens to ~/mesh; the map may take --memory MB, so that most of the way leaves memory.
Each part that the node writes is read, counted and removed. Writes benchmarks/results/soak.json
and soak.png. Ctrl-C ends it early, with what was measured so far. Exit code 1: the node ended, or
a part of the map is missing.
"""
from __future__ import annotations

import argparse
from collections import Counter
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from common import machine, table
from diagnostic_msgs.msg import DiagnosticArray
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
import rclpy
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from synthetic_camera import render, SyntheticCamera
from visualization_msgs.msg import MarkerArray

from gr2t_ros.errors import InputError
from gr2t_ros.io import formats
from gr2t_ros.ros.isolation import isolated
from gr2t_ros.ros.outputs import outputs_profile

_PROJECT = Path(__file__).resolve().parents[1]
_SPEED = 200 / 1200  # m/s: 200 m in 20 minutes
_RATE = 30.0  # Hz
# what two cores can follow
SETTINGS = {
    'voxel_size': 0.02, 'depth_bandwidth': 0.01, 'depth_max': 3.0, 'ray_stride': 4,
    'display_stride': 8}
BESIDE_MB = 700  # the process' memory besides the map's, where it compiles its kernels
_FLAT = 0.10
_LAST = 5.0  # s after the last image for what is on its way
_PATIENCE = 900.0  # s for the kernels, where they have to be compiled beside other work
_LEAK = 1.0  # MB a minute


class Soak:
    """
    One run.

    samples: a row each second, by name: minute, resident MB, map MB, ms a frame, and others.
    parts: files of keyframes that left memory, counted and removed. parts_bytes: their size.

    :param folder: for snapshots, the log and the camera's images
    :param memory: max_memory_mb
    :param size: of the images, pixels
    """

    def __init__(self, folder: Path, memory: int, size: tuple[int, int] = (640, 480)) -> None:
        self.samples: list[dict[str, float]] = []
        self.parts = self.parts_bytes = self.vertices = self.sent = 0
        self.final: dict[str, str] = {}
        self._folder = folder
        self._states: list[bytes] = []
        self._environment = isolated(os.environ)
        os.environ.update(self._environment)
        self._arguments = [
            f'{name}:={value}' for name, value in {
                **SETTINGS, 'max_memory_mb': memory, 'snapshot_directory': folder / 'snapshots',
            }.items()]
        render(folder / 'frames.npy', *size)

    def run(self, minutes: float, speed: float = _SPEED) -> bool:
        """Run for some minutes at a speed (m/s), or until Ctrl-C; tell whether it survived."""
        log = self._folder / 'node.log'
        arguments = [item for value in self._arguments for item in ('-p', value)]
        with open(log, 'wb') as file, subprocess.Popen(
                [sys.executable, '-m', 'gr2t_ros.ros.node', '--ros-args', *arguments],
                stdout=file, stderr=file, env=self._environment, start_new_session=True,
                ) as process:
            # Ctrl-C stays Python's
            rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
            node = rclpy.create_node('soak')
            node.create_subscription(
                DiagnosticArray, '/diagnostics', self._states.append, 10, raw=True)
            node.create_subscription(
                MarkerArray, '/gr2t/mesh', lambda _: None, outputs_profile(5), raw=True)
            try:
                self._wait(node, process, log)
                camera = SyntheticCamera(
                    self._folder / 'frames.npy', '--speed', f'{speed}', '--rate', f'{_RATE}',
                    environment=self._environment)
                try:
                    self._watch(node, process, camera, 60 * minutes)
                except KeyboardInterrupt:
                    print('\nended early', flush=True)
                finally:
                    camera.end()
                    self.sent = camera.sent
                self._watch(node, process, None, _LAST)
            finally:
                survived = process.poll() is None
                if survived:
                    survived = _ended(process) == 0
                self._count_parts()
                node.destroy_node()
                rclpy.try_shutdown()
        said = log.read_text(errors='replace')
        print(said[said.rfind('frames: '):] if survived else said[-3000:])
        return survived

    def _wait(self, node: Node, process: subprocess.Popen[bytes], log: Path) -> None:
        end = time.monotonic() + _PATIENCE
        while b'subscribed to' not in log.read_bytes() and process.poll() is None:
            if time.monotonic() > end:
                raise TimeoutError(f'the node has not subscribed: {log.read_text()}')
            rclpy.spin_once(node, timeout_sec=0.2)
        self._states.clear()

    def _watch(
        self, node: Node, process: subprocess.Popen[bytes], camera: SyntheticCamera | None,
        seconds: float,
    ) -> None:
        """Take a sample with each of the node's diagnostics."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and process.poll() is None:
            if camera and not camera.alive:
                raise RuntimeError('the camera has ended')
            rclpy.spin_once(node, timeout_sec=0.2)
            if self._states:
                array = deserialize_message(self._states[-1], DiagnosticArray)
                self._states.clear()
                self._sample(process.pid, array)
                if len(self.samples) % 10 == 0:
                    self._count_parts()

    def _sample(self, pid: int, array: DiagnosticArray) -> None:
        values = {item.key: item.value for status in array.status for item in status.values}
        self.final = values
        number = {key: float(value) for key, value in values.items()}
        now = time.monotonic()
        self.samples.append({
            'time': now, 'resident': _resident_mb(pid), 'map': number['memory of the map (MB)'],
            'integrated': number['integrated'], 'busy': number['worker on frames (s)'],
            'cpu': number['CPU of all (s)'], 'keyframes': number['keyframes'],
            'left': number['keyframes that left memory'], 'blocks': number['blocks'],
            'latency': number.get('stamp to publish p95 (ms)', float('nan')),
            'files': len(os.listdir(f'/proc/{pid}/fd')),
            'threads': len(os.listdir(f'/proc/{pid}/task'))})

    def _count_parts(self) -> None:
        for path in self._folder.glob('snapshots/parts_*/view_*.ply'):
            try:
                mesh = formats.read(path)
            except InputError as error:
                print(f'a damaged part: {error}')
                continue
            self.parts += 1
            self.parts_bytes += path.stat().st_size
            self.vertices += len(mesh.vertices)
            path.unlink()

    def column(self, name: str) -> NDArray[np.float64]:
        """Return all samples of a name."""
        return np.array([sample[name] for sample in self.samples])

    def cost(self, begin: float, end: float) -> float:
        """Return the worker's milliseconds a frame between two times of the run, seconds."""
        time_of = self.column('time') - self.samples[0]['time']
        inside = np.flatnonzero((time_of >= begin) & (time_of <= end))
        if len(inside) < 2:
            return float('nan')
        first, last = self.samples[inside[0]], self.samples[inside[-1]]
        frames = last['integrated'] - first['integrated']
        return 1000 * (last['busy'] - first['busy']) / frames if frames else float('nan')

    def figures(self, memory: int) -> dict[str, Any]:
        """Return what is to be said of the run."""
        seconds = self.column('time') - self.samples[0]['time']
        resident = self.column('resident')
        # the images end before the last samples
        length = float(seconds[np.argmax(self.column('integrated'))])
        span = min(60.0, length / 3)
        # half of a minute for the queues to fill
        first, last = self.cost(span / 2, 1.5 * span), self.cost(length - span, length)
        late = (seconds > length / 2) & (seconds <= length)
        slope = float(np.polyfit(seconds[late] / 60, resident[late], 1)[0]) if (
            late.sum() > 2) else float('nan')
        dropped = Counter({
            key.partition(': ')[2]: int(value) for key, value in self.final.items()
            if key.startswith('dropped')})
        return {
            'minutes': length / 60, 'sent': self.sent,
            'received': int(self.final['received']), 'integrated': int(self.final['integrated']),
            'dropped': dict(dropped), 'keyframes': int(self.final['keyframes']),
            'left memory': int(self.final['keyframes that left memory']), 'parts': self.parts,
            'parts MB': self.parts_bytes / 1e6, 'vertices': self.vertices,
            'resident MB at the end': float(resident[-1]), 'most': float(resident.max()),
            'allowed': memory + BESIDE_MB, 'slope MB/min': slope,
            'first ms': first, 'last ms': last, 'last / first': last / first,
            'p95 latency ms': float(np.nanmedian(self.column('latency'))),
            'files': [int(self.samples[n]['files']) for n in (0, -1)],
            'threads': [int(self.samples[n]['threads']) for n in (0, -1)]}

    def plot(self, path: Path, memory: int) -> None:
        """Draw memory, the cost of a frame and keyframes over time."""
        figure = Figure(figsize=(8, 7), layout='constrained')
        FigureCanvasAgg(figure)
        minutes = (self.column('time') - self.samples[0]['time']) / 60
        top, middle, bottom = figure.subplots(3, 1, sharex=True)
        top.plot(minutes, self.column('resident'), label='resident')
        top.plot(minutes, self.column('map'), label='the map, with room for a copy')
        top.axhline(memory, color='grey', linestyle='--', label='max_memory_mb')
        top.axhline(memory + BESIDE_MB, color='grey', linestyle=':', label=f'and {BESIDE_MB} MB')
        top.set_ylabel('MB')
        top.set_ylim(bottom=0)
        top.legend(loc='lower right')
        step = 10.0
        times = np.arange(0.0, 60 * minutes[-1], step)
        middle.plot((times + step / 2) / 60, [self.cost(t, t + step) for t in times])
        middle.set_ylabel('worker, ms a frame')
        middle.set_ylim(bottom=0)
        bottom.plot(minutes, self.column('keyframes'), label='keyframes')
        bottom.plot(minutes, self.column('left'), label='of them on the disk')
        bottom.legend()
        bottom.set_xlabel('minutes')
        figure.savefig(path, dpi=120)


def _ended(process: subprocess.Popen[bytes]) -> int:
    """End the node; return its exit code."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(timeout=120)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _resident_mb(pid: int) -> float:
    statm = Path(f'/proc/{pid}/statm').read_text(encoding='ascii')
    return 1e-6 * int(statm.split()[1]) * os.sysconf('SC_PAGE_SIZE')


def _said(figures: dict[str, Any]) -> list[dict[str, str]]:
    """Return the figures beside their targets."""
    counted = figures['integrated'] + sum(figures['dropped'].values())
    rows = [
        ('images sent / received', f'{figures["sent"]} / {figures["received"]}', ''),
        ('integrated', f'{figures["integrated"]}', ''),
        ('dropped', ' '.join(f'{k} {v}' for k, v in figures['dropped'].items()) or '-', ''),
        ('received, but not accounted for', f'{figures["received"] - counted}', '0'),
        ('keyframes / left memory / parts on the disk',
         f'{figures["keyframes"]} / {figures["left memory"]} / {figures["parts"]}', 'all'),
        ('resident MB, most / at the end',
         f'{figures["most"]:.0f} / {figures["resident MB at the end"]:.0f}',
         f'{figures["allowed"]}'),
        ('growth in the second half, MB a minute', f'{figures["slope MB/min"]:.2f}',
         f'{_LEAK:g}'),
        ('open files, threads: first, last', f'{figures["files"]}, {figures["threads"]}', 'equal'),
        ('worker, ms a frame, first / last minute',
         f'{figures["first ms"]:.2f} / {figures["last ms"]:.2f}', ''),
        ('last / first', f'{figures["last / first"]:.3f}', f'{1 + _FLAT:g}'),
        ('stamp to publish, 95 %, ms', f'{figures["p95 latency ms"]:.0f}', '')]
    return [{'what': what, 'measured': measured, 'at most': most} for what, measured, most in rows]


def main() -> int:
    """Run, and say what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--minutes', type=float, default=20.0)
    parser.add_argument('--memory', type=int, default=500, metavar='MB')
    parser.add_argument('--speed', type=float, default=_SPEED, metavar='M/S')
    parser.add_argument('--size', type=int, nargs=2, default=(640, 480), metavar='PIXELS')
    arguments = parser.parse_args()
    about = machine()
    print(f'{about["processor"]}, {about["cores"]} cores, load average {about["load"]:.1f}; '
          f'{arguments.minutes:g} minutes', flush=True)
    results = _PROJECT / 'benchmarks' / 'results'
    results.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix='gr2t_soak_') as folder:
        try:
            soak = Soak(Path(folder), arguments.memory, tuple(arguments.size))
            survived = soak.run(arguments.minutes, arguments.speed)
        except KeyboardInterrupt:  # before the first image
            return 130
    if len(soak.samples) < 5:
        print('too short to say anything')
        return 1
    figures = soak.figures(arguments.memory)
    with open(results / 'soak.json', 'w', encoding='utf-8') as file:
        json.dump({'machine': about, 'figures': figures, 'samples': soak.samples}, file)
    soak.plot(results / 'soak.png', arguments.memory)
    table(f'{figures["minutes"]:.1f} minutes, load average {os.getloadavg()[0]:.1f}',
          _said(figures))
    print(f'\n{results / "soak.png"}')
    return 0 if survived and figures['parts'] == figures['left memory'] else 1


if __name__ == '__main__':
    sys.exit(main())
