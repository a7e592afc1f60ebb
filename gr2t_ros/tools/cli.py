# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The executable `gr2t`: it parses, dispatches and turns errors into exit codes.

0: done; 1: it failed midway; 2: the call or the input cannot be used; 130: interrupted.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
import difflib
from importlib import import_module, metadata
import os
import sys
import traceback
from typing import NoReturn

from ..errors import Gr2tError, InputError

DONE, FAILED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130

# each is a module beside this one with add_arguments(parser) and run(args)
_COMMANDS = {
    'replay': 'turn recordings into a likelihood-coloured mesh',
    'merge': 'sum saved maps of one world, or make the mesh of one',
    'info': 'list what a recording holds and what replay would use',
    'simulate': 'record depth images of a mesh as a sensor would take them',
    'evaluate': 'measure a mesh against a reference',
    'view': 'make a page of a mesh, to turn it in a browser',
    'convert': 'write a mesh in another format, or with fewer faces',
}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f'{message}; see {self.prog} --help')

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None,
    ) -> tuple[argparse.Namespace, list[str]]:
        """Refuse what is unknown here, where the command's own options are known."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            near = difflib.get_close_matches(unknown[0], self._option_string_actions, n=1)
            hint = f' (did you mean {near[0]}?)' if near else ''
            self.error(f'unknown argument {" ".join(unknown)}{hint}')
        return found, unknown


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param arguments: default: those of the process
    :return: the exit code
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        args = _parser(arguments).parse_args(arguments)
        code: int = import_module(f'.{args.command}', __package__).run(args)
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # who reads our output, such as head, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except KeyboardInterrupt:
        print('gr2t: interrupted', file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if '--debug' in arguments:
            traceback.print_exc()
        if not isinstance(error, Gr2tError):
            print(f'gr2t: unexpected {type(error).__name__}: {error} (--debug shows where)',
                  file=sys.stderr)
            return FAILED
        print(f'gr2t: {error}', file=sys.stderr)
        return UNUSABLE if isinstance(error, InputError) else FAILED


def _parser(arguments: Sequence[str]) -> argparse.ArgumentParser:
    parser = _Parser(
        prog='gr2t', description='Likelihood-coloured meshes from depth images with known poses.')
    parser.add_argument('--version', action='version', version=f'gr2t_ros {_version()}')
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    # only the command that is meant is imported: they bring large libraries
    meant = next((item for item in arguments if item in _COMMANDS), '')
    for name, summary in _COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=f'{summary.capitalize()}.')
        if name == meant:
            import_module(f'.{name}', __package__).add_arguments(command)
            command.add_argument(
                '--debug', action='store_true', help='show where an error comes from')
    return parser


def _version() -> str:
    try:
        return metadata.version('gr2t_ros')
    except metadata.PackageNotFoundError:
        return '(not installed)'


if __name__ == '__main__':
    sys.exit(main())
