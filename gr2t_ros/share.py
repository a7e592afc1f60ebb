# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where the files that are not Python lie: presets, launch files."""
from __future__ import annotations

from pathlib import Path

from .errors import InputError

NAME = 'gr2t_ros'


def share_directory() -> Path:
    """
    Return the folder that holds package.xml, config/ and launch/.

    That is the source checkout where the package is used from one, else share/gr2t_ros of the
    prefix that colcon or pip installed it under.

    :raises InputError: if the package was copied without that folder
    """
    package = Path(__file__).resolve().parent
    places = [package.parent, *(folder / 'share' / NAME for folder in package.parents)]
    for place in places:
        if (place / 'package.xml').is_file() and (place / 'config').is_dir():
            return place
    raise InputError(
        f'the share folder of {NAME} was not found above {package}: install the package with '
        'colcon or pip')
