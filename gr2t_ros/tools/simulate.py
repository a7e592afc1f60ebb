# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Depth images of a mesh as a sensor would take them: as views, or recorded in a bag."""
from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from math import atan, degrees, sin
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
import trimesh

from ..core.camera import Camera
from ..core.view import View
from ..errors import InputError
from ..io import formats, trajectory
from .noise import KINDS, Noise
from .orbit import orbit, Pose
from .progress import Progress
from .ray_caster import RayCaster
from .recorder import record
from .scenes import SCENES

ENCODINGS = ('32FC1', '16UC1')
_FOCAL_OF_WIDTH = 525.0 / 640.0
_START_NS = 1_700_000_000_000_000_000
_PERIOD_NS = 33_333_333


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'mesh', metavar='MESH', type=Path,
        help='a mesh that trimesh reads (PLY, OBJ, STL, OFF, glTF), in metres; its coordinates '
        'are the world\'s. Or the word tabletop: a built-in scene')
    parser.add_argument(
        'output', metavar='OUT_BAG', type=Path,
        help='a new rosbag2 MCAP folder, or a bare file where it ends in .mcap')
    cameras = parser.add_argument_group('cameras')
    cameras.add_argument(
        '--views', metavar='N', type=int, help='cameras on a spiral about the mesh (12)')
    cameras.add_argument(
        '--distance', metavar='M', type=float,
        help='of the cameras from the centre of the mesh\'s bounds (so far that each sees all of '
        'it)')
    cameras.add_argument(
        '--trajectory', metavar='FILE', type=Path,
        help='instead: a text file in the TUM format, a line "timestamp tx ty tz qx qy qz qw" '
        'each image: seconds, and the pose of the camera\'s optical frame in the world')
    cameras.add_argument('--width', metavar='PX', type=int, default=640, help='(640)')
    cameras.add_argument('--height', metavar='PX', type=int, default=480, help='(480)')
    cameras.add_argument(
        '--focal', metavar='PX', type=float, help='focal length (525 at a width of 640, scaled '
        'with the width); for a field of view a it is width / (2 tan(a / 2))')
    cameras.add_argument(
        '--encoding', choices=ENCODINGS, default='32FC1',
        help='of the images: metres, or whole millimetres (32FC1)')
    sensor = parser.add_argument_group('noise', 'docs/simulation.md has the formulas')
    sensor.add_argument('--noise', choices=KINDS, default='none', help='(none)')
    sensor.add_argument(
        '--sigma', metavar='M', type=float,
        help='standard deviation of the depth, for gaussian (0.001)')
    sensor.add_argument(
        '--outliers', metavar='FRACTION', type=float, default=0.0,
        help='of the valid pixels that are moved uniformly within 5 cm (0)')
    sensor.add_argument(
        '--disparity-step', metavar='PX', type=float, default=0.0,
        help='depths are whole multiples of this disparity over a baseline of 7.5 cm; a Kinect\'s '
        'is 0.125 (0: they are not)')
    sensor.add_argument('--seed', metavar='N', type=int, default=0, help='of the noise (0)')


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    if args.sigma is not None and args.noise != 'gaussian':
        raise InputError(f'--sigma goes with --noise gaussian, not with {args.noise}')
    noise = Noise(
        args.noise, 0.001 if args.sigma is None else args.sigma, args.outliers,
        args.disparity_step)
    if args.seed < 0:
        raise InputError(f'--seed must be 0 or more, not {args.seed}')
    camera = simulated_camera(args.width, args.height, args.focal)
    scene = None if args.mesh.is_file() else SCENES.get(str(args.mesh))
    mesh = load_mesh(args.mesh)
    stamps: Sequence[int] | None = None
    if args.trajectory:
        if args.views is not None or args.distance is not None:
            raise InputError('--trajectory has the poses: give it without --views and --distance')
        stamps, poses = trajectory.read(args.trajectory)
        if len(set(stamps)) < len(stamps):
            raise InputError(f'{args.trajectory}: two poses have the same timestamp')
        way = f'along {args.trajectory}'
    else:
        distance, views = args.distance, 12 if args.views is None else args.views
        if distance is None:
            distance = scene.distance if scene else fitting_distance(mesh, camera)
        poses = (
            scene.poses(views, distance) if scene
            else orbit(mesh.bounds.mean(axis=0), distance, views))
        way = f'from {distance:.3g} m'
    images = rendered_views(mesh, camera, poses, args.encoding, noise, args.seed, stamps)
    with Progress(len(poses), 'images') as progress:
        count = record(args.output, _watched(images, progress), args.encoding)
    across, down = (
        degrees(2 * atan(size / 2 / camera.fx)) for size in (camera.width, camera.height))
    print(
        f'{args.output}: {count} images {way}, {camera.width} x {camera.height} '
        f'{args.encoding}, field of view {across:.1f} x {down:.1f} degrees, noise {args.noise}')
    return 0


def _watched(views: Iterable[View], progress: Progress) -> Iterator[View]:
    """Pass views on, provided that one at least sees something."""
    seen = False
    for count, view in enumerate(views, 1):
        seen = seen or bool(np.isfinite(view.depth).any())
        progress.reach(count)
        yield view
    if not seen:
        raise InputError(
            'no image sees the mesh: check the distance or the trajectory, and that all are in '
            'metres')


def load_mesh(path: Path) -> trimesh.Trimesh:
    """
    Read a mesh as formats.read does.

    :param path: a file, or the name of one of SCENES
    :return: with the file's attributes in vertex_attributes
    :raises InputError: if it cannot be read or has no triangles
    """
    if not path.is_file() and str(path) in SCENES:
        return SCENES[str(path)].mesh()
    mesh = formats.read(path)
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, process=False, vertex_attributes={**mesh.attributes})


def fitting_distance(mesh: trimesh.Trimesh, camera: Camera) -> float:
    """Return the distance, metres, from which a camera sees the sphere about a mesh's bounds."""
    radius = np.linalg.norm(mesh.extents) / 2
    narrower = atan(min(camera.width / camera.fx, camera.height / camera.fy) / 2)
    return float(1.05 * radius / sin(narrower))



def simulated_views(
    mesh: trimesh.Trimesh,
    views: int = 12,
    distance: float = 0.35,
    width: int = 640,
    height: int = 480,
    focal: float | None = None,
    encoding: str = '32FC1',
    noise: Noise | None = None,
    seed: int = 0,
    poses: Sequence[Pose] | None = None,
    stamps_ns: Sequence[int] | None = None,
) -> list[View]:
    """
    Return depth images of a mesh; see rendered_views.

    :param views: cameras on an orbit about the centre of the mesh's bounds
    :param distance: of the cameras from that centre, metres
    :param poses: (4, 4) T_world_camera of each image, instead of the orbit
    """
    if poses is None:
        poses = orbit(mesh.bounds.mean(axis=0), distance, views)
    camera = simulated_camera(width, height, focal)
    return list(rendered_views(mesh, camera, poses, encoding, noise, seed, stamps_ns))


def rendered_views(
    mesh: trimesh.Trimesh,
    camera: Camera,
    poses: Sequence[Pose],
    encoding: str = '32FC1',
    noise: Noise | None = None,
    seed: int = 0,
    stamps_ns: Sequence[int] | None = None,
) -> Iterator[View]:
    """
    Yield the depth image that a noisy sensor takes of a mesh at each pose.

    :param mesh: in world coordinates, metres
    :param poses: (4, 4) float64 T_world_camera each
    :param encoding: one of ENCODINGS: 16UC1 rounds depths to millimetres
    :param seed: image i depends on (seed, i) alone
    :param stamps_ns: of the images; default: 30 a second
    :raises InputError: if no ray caster is installed or the encoding is unknown
    """
    if encoding not in ENCODINGS:
        raise InputError(f'encoding must be one of {", ".join(ENCODINGS)}, not {encoding!r}')
    noise = noise or Noise()
    caster = RayCaster(mesh)
    for i, T_world_camera in enumerate(poses):
        rng = np.random.default_rng([seed, i])
        depth, angle = caster.cast(T_world_camera, camera.rays)
        offsets = noise.offsets(angle, rng)
        if offsets is not None:
            rays = camera.rays + offsets / (camera.fx, camera.fy)
            depth, angle = caster.cast(T_world_camera, rays)
        depth = noise.apply(depth, angle, camera.fx, rng)
        if encoding == '16UC1':
            depth = _millimetres(depth)
        yield View(
            depth=depth.astype(np.float32), camera=camera,
            T_world_camera=np.array(T_world_camera, np.float64),
            stamp_ns=stamps_ns[i] if stamps_ns is not None else _START_NS + i * _PERIOD_NS)


def simulated_camera(width: int = 640, height: int = 480, focal: float | None = None) -> Camera:
    """
    Return a pinhole camera whose principal point is the middle of its image.

    :param focal: pixels; default: 525 at a width of 640, scaled with the width
    :raises InputError: for sizes that no camera has
    """
    if width < 2 or height < 2 or width * height > 2 ** 26:
        raise InputError(f'an image of {width} x {height} pixels cannot be simulated')
    if focal is None:
        focal = _FOCAL_OF_WIDTH * width
    if not 0.0 < focal < np.inf:
        raise InputError(f'the focal length must be above 0 px, not {focal:g}')
    return Camera(
        width=width, height=height, fx=focal, fy=focal,
        cx=(width - 1) / 2, cy=(height - 1) / 2)


def _millimetres(depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round depths as 16UC1 does, metres to metres; 0 and what 16 bits cannot hold is NaN."""
    whole = np.round(depth * 1000.0)
    return np.where((whole > 0) & (whole < 65535), whole / 1000.0, np.nan)
