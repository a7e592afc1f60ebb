# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Coverage-guided fuzzing of what reads other people's bytes.

    python test/fuzz.py [--seconds 60] [--only NAME ...] [--corpus FOLDER]

Each decoder runs in a process of its own under atheris, from inputs that are in order. A crash is
any exception but the package's own, more than 2 GB of memory, or more than 20 s for one input; its
input is kept, and fuzzing goes on. At the end the inputs kept in test/fuzz_inputs, which crashed
once, and the new ones are tried again: those that still crash are left. Exit code 1: some are.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import closing, suppress
from functools import lru_cache
import hashlib
import io
import os
from pathlib import Path
import re
import struct
import subprocess
import sys
import tempfile
import time
from types import SimpleNamespace

INPUTS = Path(__file__).with_name('fuzz_inputs')
_MEMORY, _PATIENCE = 2048, 20  # MB, s: of one input
_MAX_SIZE = 1 << 16  # bytes
_MAX_CRASHES = 20  # that are looked for
_MESSAGES = 500  # that are read of a recording
Decoder = Callable[[bytes], object]


def decoders() -> dict[str, Decoder]:
    """Return what reads bytes, by name: each may raise the package's errors only."""
    from messages_for_tests import compressed, TYPES
    import numpy as np

    from gr2t_ros.core.reconstruction import Reconstruction
    from gr2t_ros.errors import FrameError, InputError
    from gr2t_ros.io import formats, messages
    from gr2t_ros.io.bags import Bag
    from gr2t_ros.io.map_file import MapFile
    from gr2t_ros.io.salvage import Salvage
    from gr2t_ros.io.salvage_mcap import McapSalvage
    from gr2t_ros.io.salvage_rosbag1 import Rosbag1Salvage
    from gr2t_ros.io.salvage_sqlite3 import Sqlite3Salvage
    from gr2t_ros.io.world import World
    from gr2t_ros.settings import Settings

    scratch = Path(tempfile.mkdtemp(
        dir='/dev/shm' if os.access('/dev/shm', os.W_OK) else None))  # memory: it is written often

    def file(name: str, data: bytes) -> Path:
        path = scratch / name
        path.write_bytes(data)
        return path

    def recording(ending: str) -> Decoder:
        def decode(data: bytes) -> None:
            with Bag([file(f'scan{ending}', data)]) as bag:
                for number, _ in enumerate(bag.messages(bag.topics)):
                    if number == _MESSAGES:
                        break
        return decode

    def salvage(kind: Callable[[io.BytesIO], Salvage]) -> Decoder:
        def decode(data: bytes) -> None:
            found = kind(io.BytesIO(data))
            topics = {channel.topic for channel in found.channels.values()}
            for number, _ in enumerate(found.messages(topics)):
                if number == _MESSAGES:
                    break
        return decode

    def decoded(data: bytes, kind: str) -> object | None:
        """Return a message; None: rosbags, or DDS, would not let it through."""
        try:
            return TYPES.deserialize_cdr(data, kind)
        except Exception:
            return None

    def image(data: bytes) -> object:
        height, width, step, big, kind = struct.unpack('<IIIBB', data[:14].ljust(14, b'\0'))
        encoding = ('16UC1', '32FC1', 'mono16', 'rgb8')[kind & 3]
        msg = SimpleNamespace(
            height=height, width=width, step=step, is_bigendian=big, encoding=encoding,
            data=np.frombuffer(data[14:], np.uint8))
        messages.size(msg)
        return messages.depth(msg)

    def compressed_depth(data: bytes) -> object:
        forms = ('16UC1; compressedDepth png', '16UC1; compressedDepth rvl',
                 '32FC1; compressedDepth png', '32FC1; compressedDepth rvl', '16UC1;')
        msg = compressed(forms[data[0] % len(forms)] if data else '', data[1:])
        messages.size(msg)
        return messages.depth(msg)

    def camera_info(data: bytes) -> object:
        msg = decoded(data, 'sensor_msgs/msg/CameraInfo')
        if msg is None:
            return None
        camera = messages.camera(msg, rectified=bool(msg.binning_x & 1))
        return camera.parameters if camera.width * camera.height < 500 else None

    def tf(data: bytes) -> object:
        msg = decoded(data, 'tf2_msgs/msg/TFMessage')
        world = World(Settings())
        if msg is not None:
            world.on_transforms(msg, static=False)
            for frame in world.tree.frames():
                world.watch(frame)
                with suppress(FrameError):
                    world.transform(world.tree.root(frame), frame, 0, '')
            world.on_transforms(msg, static=True)
        return world

    def mesh(data: bytes) -> object:
        found = formats.read(file('mesh.ply', data))
        return found.vertices[found.faces]

    def map_file(data: bytes) -> object:
        """Load a map whose checksum fits, so that the rest has to notice what is wrong."""
        path = file('map.gr2t', data + hashlib.sha256(data).digest())
        with MapFile(path) as opened, closing(Reconstruction(
                opened.settings.updated({'threads': 1}))) as reconstruction:
            opened.load(reconstruction)
            reconstruction.finish(0.0)
            return list(reconstruction.meshes())

    def pose(data: bytes) -> object:
        msg = decoded(data, 'nav_msgs/msg/Odometry')
        return msg and messages.pose(msg, 'odometry')

    def guarded(decode: Decoder) -> Decoder:
        def run(data: bytes) -> None:
            with suppress(FrameError, InputError):
                decode(data)
        return run

    return {name: guarded(decode) for name, decode in {
        'mcap': recording('.mcap'), 'db3': recording('.db3'), 'rosbag1': recording('.bag'),
        'mcap_salvage': salvage(McapSalvage), 'rosbag1_salvage': salvage(Rosbag1Salvage),
        'db3_salvage': salvage(lambda content: Sqlite3Salvage(file('scan.db3', content.read()))),
        'compressed_depth': compressed_depth, 'image': image, 'camera_info': camera_info, 'tf': tf,
        'pose': pose, 'ply': mesh, 'map': map_file,
    }.items()}


def seeds(folder: Path) -> None:
    """Write inputs that are in order, a folder for each decoder."""
    import bags_for_tests as bags
    import cv2
    import numpy as np

    from gr2t_ros.core.camera import Camera
    from gr2t_ros.core.colour import Colouring
    from gr2t_ros.core.reconstruction import Reconstruction
    from gr2t_ros.core.view import View
    from gr2t_ros.core.view_mesh import ViewMesh
    from gr2t_ros.io import ply
    from gr2t_ros.io.map_file import save_map
    from gr2t_ros.settings import Settings

    def seed(name: str, data: bytes) -> None:
        (folder / name).mkdir(exist_ok=True)
        (folder / name / f'seed{len(list((folder / name).iterdir()))}').write_bytes(data)

    small = [*bags.scan(2), bags.image(3, '/depth', np.zeros((2, 2), np.uint16))]
    with tempfile.TemporaryDirectory() as scratch:
        for number, kind in enumerate((
                'mcap bare', 'mcap storage zstd', 'sqlite3 bare', 'rosbag1', 'rosbag1 bz2',
                'rosbag1 lz4')):
            path = bags.write(Path(scratch) / f'scan{number}', small, kind)
            path = next(path.glob('*.mcap')) if path.is_dir() else path
            name = {'.mcap': 'mcap', '.db3': 'db3', '.bag': 'rosbag1'}[path.suffix]
            seed(name, path.read_bytes())
            seed(f'{name}_salvage', path.read_bytes())
        types = bags.types_of(ros1=False)
        for name, message in (('camera_info', bags.camera_info(1)), ('tf', bags.transform(1)),
                              ('pose', bags.pose_message(1, 'Odometry'))):
            seed(name, bytes(types.store.serialize_cdr(message.make(types), message.kind)))
        pixels = np.arange(20, dtype=np.uint16).reshape(4, 5) * 300
        png = cv2.imencode('.png', pixels)[1].tobytes()
        seed('compressed_depth', bytes(13) + png)
        seed('compressed_depth', b'\x01' + bytes(12) + struct.pack('<II', 2, 1) + b'\x12\x34' * 6)
        seed('image', struct.pack('<IIIBB', 4, 5, 10, 0, 0) + pixels.tobytes())
        ones = np.ones(3, np.float32)
        mesh = ViewMesh(np.eye(3), ones, ones, ones, np.array([[0, 1, 2]], np.int32),
                        np.array([[0, 1]], np.int32), ones[:1])
        for density in ('voxel', 'exact'):
            settings = Settings(
                density=density, voxel_size=0.9, depth_bandwidth=0.9, pixel_bandwidth=0.5)
            path = Path(scratch) / f'{density}.gr2t'
            with closing(Reconstruction(settings)) as reconstruction:
                reconstruction.add(View(
                    np.ones((3, 4), np.float32), Camera(4, 3, 4.0, 4.0, 1.5, 1.0), np.eye(4), 1))
                save_map(path, reconstruction, 'map')
            seed('map', path.read_bytes()[:-32])
        seed('ply', ply.write_view(
            Path(scratch) / 'mesh.ply', 0, mesh,
            Colouring('likelihood', 1.0, 'turbo')).path.read_bytes())


def fuzz(name: str, arguments: list[str]) -> None:
    """Fuzz one decoder, until atheris ends the process."""
    import atheris
    import numba

    # texts of types are what takes the time, and rarely change
    import rosbags.highlevel
    import rosbags.typesys
    rosbags.typesys.get_types_from_msg = lru_cache(rosbags.typesys.get_types_from_msg)
    rosbags.highlevel.anyreader.get_types_from_msg = rosbags.typesys.get_types_from_msg
    import gr2t_ros.core
    # atheris cannot look into what is compiled, and Python notices bad indices; a map's kernels
    # do not run in Python, and are to be safe by what is checked before
    numba.config.DISABLE_JIT = name != 'map'
    if name == 'map':
        import gr2t_ros.core.reconstruction  # noqa: F401
    with atheris.instrument_imports(include=[
            'gr2t_ros.io', 'gr2t_ros.core.camera', 'gr2t_ros.core.poses', 'gr2t_ros.core.state',
            'trimesh.exchange']):
        decode = decoders()[name]
    atheris.Setup([sys.argv[0], *arguments], decode)
    atheris.Fuzz()


def crashes(name: str, path: Path) -> bool:
    """Tell whether an input still crashes its decoder."""
    limit = f'import resource; resource.setrlimit(resource.RLIMIT_AS, ({_MEMORY << 21}, ) * 2)'
    try:
        return bool(subprocess.run(
            [sys.executable, '-c', f'{limit}; import sys; sys.path.insert(0, {str(path)!r}); '
             f'sys.path.insert(0, {str(INPUTS.parent)!r}); import fuzz, pathlib; '
             f'fuzz.decoders()[{name!r}](pathlib.Path({str(path)!r}).read_bytes())'],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            timeout=6 * _PATIENCE).returncode)
    except subprocess.TimeoutExpired:
        return True


def campaign(name: str, seconds: float, corpus: Path, kept: Path) -> tuple[int, list[Path]]:
    """Fuzz one decoder for some time; return the number of inputs, and those that crashed it."""
    inputs, end = 0, time.monotonic() + seconds
    found: list[Path] = []
    while (left := int(end - time.monotonic())) > 0 and len(found) < _MAX_CRASHES:
        run = subprocess.run(
            [sys.executable, __file__, '--decoder', name, f'-max_total_time={left}',
             f'-artifact_prefix={kept}/{name}-', f'-rss_limit_mb={_MEMORY}',
             f'-timeout={_PATIENCE}', f'-max_len={_MAX_SIZE}', '-print_final_stats=1',
             '-verbosity=1', str(corpus / name)],
            capture_output=True, text=True, errors='replace')
        counts = re.findall(r'^stat::number_of_executed_units:\s+(\d+)', run.stderr, re.M) or (
            re.findall(r'^#(\d+)', run.stderr, re.M))
        inputs += int(counts[-1]) if counts else 0
        new = sorted(set(kept.glob(f'{name}-*')) - set(found))
        real = [path for path in new if '-crash-' in path.name or crashes(name, path)]
        for path in set(new) - set(real):
            path.unlink()  # watching Python takes memory, the more the longer it runs, and time
        found += real
        if real:
            report = kept / f'report-{real[-1].name}.txt'
            report.write_text(run.stdout + run.stderr)
            print(f'  {name}: {real[-1]}, explained in {report}', flush=True)
        elif not counts:
            raise SystemExit(f'{name} could not be fuzzed:\n{run.stderr[-2000:]}')
        elif not new:
            break
    return inputs, found


def main() -> int:
    """Fuzz what the command line says; print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=(
        argparse.RawDescriptionHelpFormatter))
    parser.add_argument('--seconds', type=float, default=60.0, help='of each decoder (60)')
    parser.add_argument('--only', nargs='+', default=[], metavar='NAME', help='these decoders')
    parser.add_argument('--corpus', type=Path, help='a folder to go on from, and to add to')
    options = parser.parse_args()
    os.nice(10)
    names = options.only or list(decoders())
    with tempfile.TemporaryDirectory() as scratch:
        corpus = options.corpus or Path(scratch)
        corpus.mkdir(parents=True, exist_ok=True)
        seeds(corpus)
        kept = Path(tempfile.mkdtemp(prefix='fuzz-'))
        rows, left = [], 0
        for name in names:
            inputs, found = campaign(name, options.seconds, corpus, kept)
            known = sorted(INPUTS.glob(f'{name}-*'))
            still = sum(crashes(name, path) for path in [*known, *found])
            rows.append((name, inputs, len(found), len(known), still))
            print(f'{name}: {inputs} inputs, {len(found)} crashes', flush=True)
            left += still
    print(f'{"decoder":18}{"inputs tried":>14}{"crashes found":>15}{"found before":>14}'
          f'{"crashes left":>14}')
    for row in rows:
        print(f'{row[0]:18}{row[1]:14}{row[2]:15}{row[3]:14}{row[4]:14}')
    return int(bool(left))


if __name__ == '__main__':
    if sys.argv[1:2] == ['--decoder']:
        fuzz(sys.argv[2], sys.argv[3:])
    else:
        sys.exit(main())
