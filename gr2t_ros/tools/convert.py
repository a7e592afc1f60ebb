# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`gr2t convert`: a mesh in another program's format, or with fewer faces."""
from __future__ import annotations

import argparse
from pathlib import Path

from ..io import formats
from .options import count


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        'mesh', metavar='MESH', type=Path, help='a mesh that trimesh reads (PLY, GLB, OBJ ...)')
    parser.add_argument(
        'output', metavar='OUT', type=Path,
        help=f'the new file; its ending says the format: {", ".join(formats.WRITTEN)}')
    parser.add_argument(
        '--max-faces', metavar='N', type=count, help='leave out detail down to N faces')


def run(args: argparse.Namespace) -> int:
    """
    Run the command.

    :raises InputError: if the mesh cannot be read or the ending is of no known format
    :raises Gr2tError: if the file cannot be written
    """
    formats.check_ending(args.output)
    mesh = formats.read(args.mesh)
    before = len(mesh.faces)
    if args.max_faces is not None:
        mesh = formats.decimated(mesh, args.max_faces)
    formats.write(args.output, mesh)
    faces = f'{len(mesh.faces)} faces' + (f' of {before}' if len(mesh.faces) < before else '')
    size = args.output.stat().st_size / 1e6
    print(f'{args.output}  {len(mesh.vertices)} vertices, {faces}, {size:.1f} MB')
    lost = formats.WRITTEN[args.output.suffix.lower()]
    if lost:
        print(f'note: {lost}')
    return 0
