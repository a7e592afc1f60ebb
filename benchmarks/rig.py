# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A running gr2t_node that is fed by a camera of its own, and what it says over DDS."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import rclpy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger
from synthetic_camera import SyntheticCamera
from visualization_msgs.msg import MarkerArray

from gr2t_ros.errors import InputError
from gr2t_ros.io import formats
from gr2t_ros.ros.isolation import isolated
from gr2t_ros.ros.outputs import outputs_profile

_PATIENCE = 120.0  # s: for what takes a few on a machine that does nothing else
_COMPILING = 900.0  # s for the kernels, where they have to be compiled beside other work
_LAST = 30  # diagnostics within which the last images are accounted for
_PARTS = re.compile(r'(\d+) keyframes that left memory are in (.*?): ')
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
    :param settings: of the node
    :param camera: arguments of the camera
    """

    def __init__(
        self, folder: Path, frames: Path, settings: Mapping[str, Any],
        camera: Sequence[str],
    ) -> None:
        self.folder, self.frames = folder, frames
        self._settings, self._camera = settings, camera
        self.snapshots = folder / 'snapshots'
        self.flag = folder / 'fail'
        self.environment = isolated(os.environ)
        os.environ.update(self.environment)
        # Ctrl-C stays Python's
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node('chaos')
        self._states: list[bytes] = []
        self._node.create_subscription(
            DiagnosticArray, '/diagnostics', self._note, 10, raw=True)
        self.acknowledged: list[Path] = []
        self._parts: dict[Path, int] = {}  # folder -> keyframes that it holds at least
        self.place = 0.0
        self.process = self.start_node('gr2t')
        self.camera = self.start_camera()

    def listen_to_meshes(self) -> None:
        """Subscribe to ~/mesh, so that it is published."""
        self._node.create_subscription(
            MarkerArray, '/gr2t/mesh', lambda _: None, outputs_profile(5), raw=True)

    def start_node(self, name: str) -> subprocess.Popen[bytes]:
        """Start a node of this name, with the same folder for snapshots."""
        log = self.folder / f'{name}.log'
        arguments = [item for key, value in {
            **self._settings, 'snapshot_directory': self.snapshots}.items()
            for item in ('-p', f'{key}:={value}')]
        with open(log, 'ab') as file:
            began = file.tell()
            process = subprocess.Popen(
                [sys.executable, '-c', _FAILING, str(self.flag), '--ros-args', '-r',
                 f'__node:={name}', *arguments],
                stdout=file, stderr=file, env=self.environment, start_new_session=True)
        try:
            self.wait(
                lambda: b'subscribed to' in log.read_bytes()[began:] or process.poll() is not None,
                f'{name} to subscribe', _COMPILING)
        except BaseException:
            process.kill()
            raise
        return process

    def start_camera(self) -> SyntheticCamera:
        """Start a camera where the last one ended."""
        self.place += 0.5
        return SyntheticCamera(
            self.frames, *self._camera, '--start', f'{self.place}', environment=self.environment)

    def wait(
        self, condition: Callable[[], Any], what: str, patience: float = _PATIENCE
    ) -> Any:
        """Serve callbacks until a condition is true; return its value."""
        end = time.monotonic() + patience
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

    def call(
        self, kind: Any, service: str, node: str = 'gr2t',
        meanwhile: Callable[[], None] = lambda: None, **fields: Any,
    ) -> Any:
        """Return a service's answer; None where the node ends before."""
        client = self._node.create_client(kind, f'/{node}/{service}')
        try:
            self.wait(client.service_is_ready, f'the service {service}')
            answer = client.call_async(kind.Request(**fields))
            process = self.process
            meanwhile()
            self.wait(lambda: answer.done() or process.poll() is not None, service)
            self.spin(0.0 if answer.done() else 0.2)
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
        unaccounted = self.unaccounted()
        missing = sum(not _whole(path) for path in self.acknowledged)
        missing += sum(
            max(count - len(list(folder.glob('[!.]*.ply'))), 0)
            for folder, count in self._parts.items())
        twice = len(self.acknowledged) - len(set(self.acknowledged))
        damaged = sum(not _whole(path) for path in self.snapshots.rglob('[!.]*.ply'))
        self.camera = self.start_camera()
        return abs(unaccounted) + missing + twice + damaged

    def unaccounted(self) -> int:
        """Return how many images of an ended camera are neither in the map nor dropped."""
        for _ in range(_LAST):  # the worker may have some in its hands
            self._states.clear()
            self.wait(lambda: self._states, 'diagnostics')
            missing = self.count('received') - self.count('integrated') - self.dropped()
            if not missing:
                break
        return missing

    def parts(self) -> int:
        """Return the number of keyframes that left memory and are on the disk."""
        return len(list(self.snapshots.glob('parts_*/[!.]*.ply')))

    def close(self) -> None:
        """End all."""
        if self.camera.alive:
            self.camera.kill()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            try:
                self.process.wait(timeout=120)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
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
