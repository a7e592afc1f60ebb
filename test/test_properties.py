# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""For every input of each decoder: what is right comes back, what is wrong is refused."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import struct
from types import SimpleNamespace
from typing import Any

import cv2
from fuzz import decoders, INPUTS
from hypothesis import example, given, HealthCheck, settings, strategies
from hypothesis.extra.numpy import array_shapes, arrays
from messages_for_tests import camera_info, compressed, image, pose_message, tf, transform, TYPES
import numpy as np
import pytest

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.colour import Colouring
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.errors import FrameError, InputError
from gr2t_ros.io import formats, messages, ply
from gr2t_ros.io.cdr import Marker, marker_array
from gr2t_ros.io.frames import FrameAssembler
from gr2t_ros.settings import Settings

examples = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
few = settings(examples, max_examples=25)
SIZES = array_shapes(min_dims=2, max_dims=2, max_side=12)
ANY_FLOAT = strategies.floats(width=64)
ANY_INT = strategies.one_of(
    strategies.integers(-2, 20), strategies.sampled_from([2**16, 2**31 - 1, 2**32 - 1, 2**63]))


def accepted(decode: Callable[[], Any]) -> Any:
    """Return what was decoded; None where it was refused with a sentence."""
    try:
        return decode()
    except FrameError as error:
        assert error.reason.isidentifier() and 20 < len(str(error)) < 600  # noqa: PT017
        return None


@given(
    pixels=arrays(np.uint16, SIZES) | arrays(
        np.float32, SIZES, elements=strategies.floats(width=32)),
    big=strategies.booleans(), padding=strategies.integers(0, 9), mono=strategies.booleans())
@examples
def test_an_image_of_either_endianness_with_padded_rows(
    pixels: Any, big: bool, padding: int, mono: bool
) -> None:
    whole = pixels.dtype == np.uint16
    stored = pixels.astype(pixels.dtype.newbyteorder('>' if big else '<'))
    rows = [row.tobytes() + b'\xa5' * padding for row in stored]
    data = b''.join(rows)[:-padding or None]  # the last row needs none
    msg = image(
        pixels, ('mono16' if mono else '16UC1') if whole else '32FC1', is_bigendian=int(big),
        step=len(rows[0]), data=np.frombuffer(data, np.uint8))
    metres = messages.depth(msg)
    assert metres.dtype == np.float32 and metres.shape == pixels.shape
    if whole:
        invalid = (pixels == 0) | (pixels == 65535)
        expected = pixels.astype(np.float32) / np.float32(1000)
    else:
        invalid = ~((pixels > 0) & np.isfinite(pixels))
        expected = pixels
    np.testing.assert_array_equal(metres, np.where(invalid, np.float32(np.nan), expected))


@given(
    height=ANY_INT, width=ANY_INT, step=ANY_INT, encoding=strategies.sampled_from(
        ['16UC1', 'mono16', '32FC1', 'rgb8', '', '\0']) | strategies.text(max_size=5),
    data=strategies.binary(max_size=200), big=strategies.integers(0, 255))
@example(height=-1, width=-1, step=0, encoding='16UC1', data=b'', big=0)
@examples
def test_images_of_any_numbers_are_read_or_refused(
    height: int, width: int, step: int, encoding: str, data: bytes, big: int
) -> None:
    msg = image(np.zeros((1, 1), np.uint16), encoding, height=height, width=width, step=step,
                is_bigendian=big, data=np.frombuffer(data, np.uint8))
    metres = accepted(lambda: messages.depth(msg))
    if metres is not None:
        assert metres.shape == (height, width) == messages.size(msg)
        assert not (metres <= 0).any() and not np.isinf(metres).any()
    mask = accepted(lambda: messages.mask(SimpleNamespace(
        height=height, width=width, step=step, encoding='mono8', data=data)))
    assert mask is None or mask.shape == (height, width)


def rvl(pixels: Any) -> bytes:
    """Compress as Wilson's paper says, by its text."""
    nibbles: list[int] = []

    def write(value: int) -> None:
        while True:
            nibbles.append(value & 7 | (8 if value > 7 else 0))
            value >>= 3
            if not value:
                return

    flat = pixels.reshape(-1).astype(int)
    at = previous = 0
    while at < len(flat):
        zeros = at
        while at < len(flat) and flat[at] == 0:
            at += 1
        write(at - zeros)
        others = at
        while at < len(flat) and flat[at] != 0:
            at += 1
        write(at - others)
        for value in flat[others:at]:
            delta = int(value) - previous
            write(delta << 1 if delta >= 0 else (-delta << 1) - 1)
            previous = int(value)
    nibbles += [0] * (-len(nibbles) % 8)
    words = [sum(nibble << (28 - 4 * i) for i, nibble in enumerate(nibbles[n:n + 8]))
             for n in range(0, len(nibbles), 8)]
    height, width = pixels.shape
    return struct.pack('<II', width, height) + struct.pack(f'<{len(words)}I', *words)


@given(pixels=arrays(np.uint16, SIZES))
@examples
def test_compressed_depth_comes_back(pixels: Any) -> None:
    metres = messages.depth(image(pixels))
    png = cv2.imencode('.png', pixels)[1].tobytes()
    for name, data in (('png', png), ('rvl', rvl(pixels))):
        msg = compressed(f'16UC1; compressedDepth {name}', bytes(12) + data)
        np.testing.assert_array_equal(messages.depth(msg), metres)
        assert messages.size(msg) == pixels.shape


@given(
    a=strategies.floats(10, 1000, width=32), b=strategies.floats(0, 100, width=32),
    pixels=arrays(np.uint16, SIZES))
@examples
def test_quantised_inverse_depth(a: float, b: float, pixels: Any) -> None:
    config = struct.pack('<iff', 0, a, b)
    metres = messages.depth(compressed('32FC1; compressedDepth rvl', config + rvl(pixels)))
    with np.errstate(divide='ignore', invalid='ignore'):
        expected = np.float32(a) / (pixels.astype(np.float32) - np.float32(b))
    valid = (pixels != 0) & (expected > 0) & np.isfinite(expected)
    np.testing.assert_array_equal(np.isfinite(metres), valid)
    np.testing.assert_array_equal(metres[valid], expected[valid])


@given(
    form=strategies.sampled_from([
        '16UC1; compressedDepth png', '32FC1; compressedDepth rvl', '16UC1; compressedDepth']),
    pixels=arrays(np.uint16, (5, 6)), where=strategies.integers(0, 200),
    change=strategies.binary(max_size=6), keep=strategies.integers(0, 300))
@examples
def test_damaged_compressed_depth_is_read_or_refused(
    form: str, pixels: Any, where: int, change: bytes, keep: int
) -> None:
    content = rvl(pixels) if 'rvl' in form else cv2.imencode('.png', pixels)[1].tobytes()
    data = bytearray(bytes(12) + content)
    data[where:where + len(change)] = change
    msg = compressed(form, bytes(data[:keep]))
    metres = accepted(lambda: messages.depth(msg))
    assert metres is None or metres.shape == messages.size(msg)


@given(
    numbers=strategies.lists(ANY_FLOAT, min_size=9, max_size=9), D=strategies.lists(
        ANY_FLOAT, max_size=14), model=strategies.sampled_from(
        ['plumb_bob', 'rational_polynomial', 'equidistant', '', 'other']),
    size=strategies.tuples(ANY_INT, ANY_INT), rectified=strategies.booleans())
@example([90.0, 0, 2, 0, 90.0, 2, 0, 0, 1], [1e300] * 5, 'plumb_bob', (5, 5), False)
@example([90.0, 0, 2, 0, 90.0, 2, 0, 0, 1], [1e9] * 4, 'equidistant', (5, 5), False)
@examples
def test_a_camera_is_one_that_has_rays_or_it_is_refused(
    numbers: list[float], D: list[float], model: str, size: tuple[int, int], rectified: bool
) -> None:
    msg = camera_info(width=size[0], height=size[1], k=np.array(numbers), d=np.array(D),
                      distortion_model=model, p=np.array([*numbers, *numbers[:3]]))
    camera = accepted(lambda: messages.camera(msg, rectified=rectified))
    if camera is not None and 0 < camera.width * camera.height < 10_000:
        rays = camera.rays
        assert rays.shape == (camera.height, camera.width, 2)
        assert not np.isinf(rays).any() and np.nanmax(np.abs(rays), initial=0) < 11


@given(numbers=strategies.lists(ANY_FLOAT, min_size=7, max_size=7), unit=strategies.booleans(),
       kind=strategies.sampled_from(['pose', 'pose_with_covariance', 'odometry', 'transform']))
@examples
def test_a_pose_is_a_rigid_motion_or_it_is_refused(
    numbers: list[float], unit: bool, kind: str
) -> None:
    quaternion = np.array(numbers[3:])
    with np.errstate(all='ignore'):
        if unit:
            quaternion /= np.linalg.norm(quaternion)
    msg = pose_message(kind, 0, np.eye(4), child='camera')
    if kind == 'transform':
        place, turn = msg.transform.translation, msg.transform.rotation
    else:
        pose = msg.pose if kind == 'pose' else msg.pose.pose
        place, turn = pose.position, pose.orientation
    place.x, place.y, place.z = numbers[:3]
    turn.x, turn.y, turn.z, turn.w = map(float, quaternion)
    found = accepted(lambda: messages.pose(msg, kind))
    if found is not None:
        R = found.T_parent_child[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(R) > 0 and np.isfinite(found.T_parent_child).all()


FRAMES = strategies.sampled_from(['map', 'odom', 'camera', '/camera', '', 'a'])
STAMPS = strategies.integers(-2, 40).map(lambda n: n * 50_000_000) | strategies.integers(
    -2**31 * 10**9, 2**32 * 10**9)


@given(strategies.lists(strategies.one_of(
    strategies.tuples(strategies.just('tf'), FRAMES, FRAMES, STAMPS, ANY_FLOAT),
    strategies.tuples(strategies.just('static'), FRAMES, FRAMES, STAMPS, ANY_FLOAT),
    strategies.tuples(strategies.just('info'), FRAMES, FRAMES, STAMPS, ANY_FLOAT),
    strategies.tuples(strategies.just('image'), FRAMES, FRAMES, STAMPS, ANY_FLOAT)), max_size=40))
@examples
def test_whatever_comes_each_image_is_a_view_or_counted_or_waits(
    events: list[tuple[str, str, str, int, float]]
) -> None:
    assembler = FrameAssembler(Settings(), rectified=False, max_waiting=3)
    views = 0
    for kind, frame, other, stamp_ns, number in events:
        if kind in ('tf', 'static'):
            T = np.eye(4)
            T[0, 3] = number
            assembler.world.on_transforms(
                tf(transform(frame, other, stamp_ns, T)), kind == 'static')
        elif kind == 'info':
            assembler.on_camera_info(camera_info(stamp_ns=stamp_ns, frame=frame, focal=number))
        else:
            assembler.on_depth(image(
                np.full((6, 8), 1500, np.uint16), stamp_ns=stamp_ns, frame=frame))
        found = assembler.ready()
        assert all(np.isfinite(view.T_world_camera).all() for view in found)
        views += len(found)
        assert assembler.waiting <= 3
        assert assembler.read == views + assembler.waiting + assembler.dropped.total()
    assert set(assembler.dropped) <= set(assembler.explanations)


@given(
    text=strategies.text('abc/é', max_size=9), points=strategies.lists(
        arrays(np.float64, (3, 3)), max_size=4), width=strategies.none() | ANY_FLOAT)
@few
def test_markers_are_read_by_another_reader_as_they_were(
    text: str, points: list[Any], width: float | None
) -> None:
    markers = [
        Marker(number, p, np.full((3, 3), 51, np.uint8), width)
        for number, p in enumerate(points)]
    data = marker_array(text, 'mesh', markers)
    found = TYPES.deserialize_cdr(data, 'visualization_msgs/msg/MarkerArray').markers
    assert len(found) == len(markers)
    for marker, item in zip(found, markers):
        assert (marker.header.frame_id, marker.ns, marker.id) == (text, 'mesh', item.id)
        np.testing.assert_array_equal(
            [[p.x, p.y, p.z] for p in marker.points], item.points)
        np.testing.assert_allclose([c.g for c in marker.colors], 0.2, rtol=1e-6)


@given(where=strategies.floats(0, 1), change=strategies.binary(min_size=1, max_size=8),
       keep=strategies.floats(0, 2))
@few
def test_a_damaged_ply_file_is_read_or_refused(
    ply_file: Path, where: float, change: bytes, keep: float
) -> None:
    content = bytearray(ply_file.read_bytes())
    # most of what can go wrong is in the header
    begin = int(where * 700)
    content[begin:begin + len(change)] = change
    path = ply_file.with_name('damaged.ply')
    path.write_bytes(content[:int(keep * len(content))])
    try:
        mesh = formats.read(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017
    else:
        assert np.isfinite(mesh.vertices).all()
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)


@pytest.fixture(scope='module')
def ply_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a small file."""
    mesh = ViewMesh(
        vertices=np.eye(3), vertex_likelihood=np.ones(3, np.float32),
        vertex_sigma=np.ones(3, np.float32), vertex_confidence=np.ones(3, np.float32),
        faces=np.array([[0, 1, 2]], np.int32), edges=np.array([[0, 1]], np.int32),
        edge_likelihood=np.ones(1, np.float32))
    path = tmp_path_factory.mktemp('ply') / 'mesh.ply'
    return ply.write_view(path, 0, mesh, Colouring('likelihood', 1.0, 'turbo')).path


def test_a_camera_that_is_right_is_taken() -> None:
    assert accepted(lambda: messages.camera(camera_info(), rectified=True)) == Camera(
        8, 6, 10.0, 10.0, 4.0, 3.0)


@pytest.mark.parametrize('path', sorted(INPUTS.iterdir()), ids=lambda path: path.name)
def test_what_fuzzing_found_is_read_or_refused(path: Path) -> None:
    """Whatever else a decoder raises fails this."""
    decoders()[path.name.partition('-')[0]](path.read_bytes())
