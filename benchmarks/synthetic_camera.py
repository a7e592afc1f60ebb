# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A depth camera that moves along an endless wall, as a process of its own that can be killed.

    python benchmarks/synthetic_camera.py FRAMES.npy [--rate 30] [--speed 0.167] [--start M]

Publishes depth/image (16UC1), depth/camera_info and /tf, stamped with the time of now, and prints
`sent N` ten times a second. The wall repeats itself every 2 m, so that FRAMES.npy, of render(),
holds all that is ever seen. Lines on its standard input change what it does: `tf off`, `tf on`,
`clock S` (s added to all stamps), `images off`, `images on`, `rate HZ`, `jump M` (the camera is
elsewhere), `bad N` (that many damaged images), `wrong N` (that many calibrations, and then poses,
that are no numbers), `end`.
"""
from __future__ import annotations

import argparse
from array import array
from pathlib import Path
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

PERIOD = 2.0  # m
_DISTANCE = 1.5  # m from the wall
_FRAMES = 240  # a period
_SPHERES = np.array([  # x, y, depth behind the wall's face, radius; m
    [0.2, -0.3, 0.1, 0.35], [0.9, 0.35, 0.05, 0.25], [1.5, -0.1, 0.15, 0.45],
    [1.8, 0.5, 0.0, 0.15]])
_SIGMA = 0.003  # m, of the noise
_FRAME, _WORLD = 'camera', 'map'


def intrinsics(width: int, height: int) -> tuple[float, float, float]:
    """Return the focal length and the centre, pixels."""
    return 0.82 * width, (width - 1) / 2, (height - 1) / 2


def camera_pose(x: float) -> NDArray[np.float64]:
    """Return T_world_camera at a place along the wall (m): it looks about a little."""
    turn = 0.15 * np.sin(2 * np.pi * x / PERIOD)
    T = np.eye(4)
    T[:3, :3] = [
        [np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    T[:3, 3] = x, 0.1 * np.cos(2 * np.pi * x / PERIOD), 0
    return T


def render(path: Path, width: int, height: int, count: int = _FRAMES) -> None:
    """Write what the camera sees in one period, (count, height, width) uint16, millimetres."""
    f, cx, cy = intrinsics(width, height)
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - cx) / f, (v - cy) / f, np.ones(u.shape)], axis=-1)
    rng = np.random.default_rng(0)
    frames = np.zeros((count, height, width), np.uint16)
    for n in range(count):
        T = camera_pose(n * PERIOD / count)
        directions = rays @ T[:3, :3].T
        depth = _DISTANCE / directions[..., 2]
        square = np.sum(directions ** 2, axis=-1)
        for shift in (-PERIOD, 0.0, PERIOD):
            for x, y, behind, radius in _SPHERES:
                centre = np.array([x + shift, y, _DISTANCE + behind]) - T[:3, 3]
                along = directions @ centre / square
                inside = along ** 2 - (centre @ centre - radius ** 2) / square
                near = along - np.sqrt(np.maximum(inside, 0.0))
                depth = np.where(inside > 0, np.minimum(depth, near), depth)
        noisy = depth + rng.normal(0, _SIGMA, depth.shape)
        frames[n] = np.round(1000 * noisy)
    np.save(path, frames)


class SyntheticCamera:
    """
    The camera's process, seen from a benchmark or a test.

    sent: images, as far as it told.

    :param frames: of render
    :param arguments: of the command line
    :param environment: of the process
    """

    def __init__(self, frames: Path, *arguments: str, environment: dict[str, str]) -> None:
        self.sent = 0
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(frames), *arguments], env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            start_new_session=True)  # Ctrl-C is not for it: it ends with its input
        threading.Thread(target=self._listen, daemon=True).start()

    def tell(self, line: str) -> None:
        """Give it a line of its input."""
        assert self._process.stdin is not None
        self._process.stdin.write(f'{line}\n')
        self._process.stdin.flush()

    def kill(self) -> None:
        """End it in the middle of whatever it does."""
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """End it after the image at hand, so that `sent` is all."""
        if self._process.poll() is None:
            self.tell('end')
        self._process.wait(timeout=30)

    @property
    def alive(self) -> bool:
        """Return whether it runs."""
        return self._process.poll() is None

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.sent = int(line.split()[1])


class _State:
    """What the lines of the input say."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.tf = self.images = True
        self.shift_ns = 0
        self.jump = 0.0
        self.bad = self.uncalibrated = self.lost = 0
        self.ended = False

    def read(self) -> None:
        """Follow the standard input to its end."""
        for line in sys.stdin:
            word, _, value = line.strip().partition(' ')
            if word in ('tf', 'images'):
                setattr(self, word, value == 'on')
            elif word == 'clock':
                self.shift_ns = round(float(value) * 1e9)
            elif word in ('rate', 'jump'):
                setattr(self, word, float(value))
            elif word == 'bad':
                self.bad = int(value)
            elif word == 'wrong':
                self.uncalibrated = self.lost = int(value)
            elif word == 'end':
                break
        self.ended = True


def main() -> None:
    """Publish until told to end."""
    from geometry_msgs.msg import TransformStamped
    import rclpy
    from rclpy.qos import QoSProfile
    from rclpy.serialization import serialize_message
    from rclpy.time import Time
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_msgs.msg import TFMessage

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('frames', type=Path)
    parser.add_argument('--rate', type=float, default=30.0, help='Hz')
    parser.add_argument('--speed', type=float, default=200 / 1200, help='m/s')
    parser.add_argument('--start', type=float, default=0.0, help='where it begins, m')
    arguments = parser.parse_args()
    frames = np.load(arguments.frames, mmap_mode='r')
    count, height, width = frames.shape
    state = _State(arguments.rate)
    threading.Thread(target=state.read, daemon=True).start()

    rclpy.init(args=[])
    node = rclpy.create_node('synthetic_camera')
    profile = QoSProfile(depth=10)
    images = node.create_publisher(Image, 'depth/image', profile)
    infos = node.create_publisher(CameraInfo, 'depth/camera_info', profile)
    transforms = node.create_publisher(TFMessage, '/tf', QoSProfile(depth=100))
    f, cx, cy = intrinsics(width, height)
    info = CameraInfo(height=height, width=width, k=[f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0])
    image = Image(
        height=height, width=width, encoding='16UC1', step=2 * width,
        data=array('B', bytes(2 * width * height)))
    info.header.frame_id = image.header.frame_id = _FRAME
    template = serialize_message(image)
    before, after = template[:4], template[12:-2 * width * height]
    damaged = _damaged(image)
    sent = 0
    began = due = told = time.monotonic()
    while not state.ended:
        x = arguments.start + arguments.speed * (due - began) + state.jump
        # a frame's own place: the poses are exact
        n = round(x / PERIOD * count)
        stamp = Time(nanoseconds=time.time_ns() + state.shift_ns).to_msg()
        if state.tf:
            message = TransformStamped(child_frame_id=_FRAME)
            message.header.stamp, message.header.frame_id = stamp, _WORLD
            _fill(message.transform, camera_pose(n * PERIOD / count))
            if state.lost and not state.uncalibrated:
                state.lost -= 1
                message.transform.rotation.w = float('nan')
            transforms.publish(TFMessage(transforms=[message]))
        info.header.stamp = stamp
        info.k[0] = float('nan') if state.uncalibrated else f
        infos.publish(info)
        state.uncalibrated = max(state.uncalibrated - 1, 0)
        if state.bad:
            state.bad -= 1
            bad = damaged[state.bad % len(damaged)]
            bad.header.stamp = stamp
            images.publish(bad)
            sent += 1
        elif state.images:
            stamped = np.array([stamp.sec, stamp.nanosec], '<u4').tobytes()
            images.publish(before + stamped + after + frames[n % count].tobytes())
            sent += 1
        if time.monotonic() > told + 0.1:
            told = time.monotonic()
            print(f'sent {sent}', flush=True)
        due = max(due + 1 / state.rate, time.monotonic() - 1.0)  # no burst after a pause
        time.sleep(max(due - time.monotonic(), 0.0))
    print(f'sent {sent}', flush=True)
    time.sleep(0.5)  # for what is on its way
    node.destroy_node()
    rclpy.try_shutdown()


def _fill(transform: Any, T: NDArray[np.float64]) -> None:
    from scipy.spatial.transform import Rotation
    place, turn = transform.translation, transform.rotation
    place.x, place.y, place.z = map(float, T[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_matrix(T[:3, :3]).as_quat())


def _damaged(image: Any) -> list[Any]:
    """Return images that no node can use."""
    kind = type(image)
    few = array('B', bytes(64))
    return [
        kind(header=image.header),
        kind(header=image.header, height=480, width=640, encoding='16UC1', step=1280, data=few),
        kind(header=image.header, height=4, width=8, encoding='rgb8', step=16, data=few),
        kind(header=image.header, height=4, width=8, encoding='16UC1', step=3, data=few),
        kind(header=image.header, height=2 ** 31, width=2 ** 31, encoding='16UC1', step=2 ** 31,
             data=few),
        kind(header=image.header, height=4, width=8, encoding='16UC1', step=16, data=few)]


if __name__ == '__main__':
    main()
