#!/usr/bin/env python3
# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Write config/gr2t.yaml and docs/parameters.md from the table in gr2t_ros/settings.py."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import Field, fields
from pathlib import Path
import sys
import textwrap
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import yaml  # noqa: E402

from gr2t_ros.settings import GROUPS, Settings  # noqa: E402

YAML_HEAD = """\
# Every parameter of gr2t_node and of the command line, with its default.
# scripts/write_parameters.py writes this file.
#
#   ros2 run gr2t_ros gr2t_node --ros-args --params-file gr2t.yaml
#   gr2t replay BAG --params gr2t.yaml
#
# Values given after it win: -p name:=value.
/**:
  ros__parameters:
"""

MARKDOWN_HEAD = """\
# Parameters

Of `gr2t_node` and of the command line; scripts/write_parameters.py writes this page. Give them as
`-p name:=value`, or in a file like [config/gr2t.yaml](../config/gr2t.yaml), which holds all with
their defaults. A running node describes its own: `ros2 param describe /gr2t NAME`. Those
marked * can change while it runs (`ros2 param set /gr2t depth_max 3`), the others at its start.
"""

PRESETS_HEAD = """\
## Presets

`gr2t replay BAG --preset NAME`, `ros2 launch gr2t_ros live.launch.py preset:=NAME`. Each is a file
in [config](../config), which names the source of its numbers and the camera's usual topics. h3 is
about one standard deviation of the noise at the depth z, both in metres.

| Preset | For | Depths | h3 |
|---|---|---|---|
"""


def yaml_text() -> str:
    """Return config/gr2t.yaml."""
    lines = []
    for group, items in groups():
        lines += ['', f'    # ---- {group}']
        for item in items:
            about = [item.metadata['help'], _limits(item, ' | ')]
            lines += ['', *(
                f'    # {line}' for text in about for line in textwrap.wrap(text, 93))]
            lines.append(f'    {item.name}: {value_text(item.default)}')
    return YAML_HEAD + '\n'.join(lines) + '\n'


def markdown_text() -> str:
    """Return docs/parameters.md."""
    lines = [MARKDOWN_HEAD]
    for group, items in groups():
        lines += [f'## {group}', '', '| Parameter | Default | Range | |', '|---|---|---|---|']
        for item in items:
            lines.append(
                f'| `{item.name}`{" *" * item.metadata["live"]} | {value_text(item.default)} | '
                f'{_limits(item, ", ")} | '
                f'{item.metadata["help"]} |')
        lines.append('')
    return '\n'.join(lines) + '\n' + PRESETS_HEAD + '\n'.join(map(_preset, presets())) + '\n'


def presets() -> list[Path]:
    """Return the parameter files for sensors and scenes."""
    return [path for path in sorted((ROOT / 'config').glob('*.yaml')) if path.stem != 'gr2t']


def _preset(file: Path) -> str:
    """Return a preset's row."""
    text = file.read_text(encoding='utf-8')
    values = Settings().updated(yaml.safe_load(text)['/**']['ros__parameters'])
    return (
        f'| `{file.stem}` | {text.splitlines()[0].lstrip("# ")} '
        f'| {values.depth_min:g} to {values.depth_max:g} m '
        f'| {values.depth_bandwidth:g} + {values.depth_bandwidth_quadratic:g} z² |')


def groups() -> Iterator[tuple[str, list[Field[Any]]]]:
    """Yield each group's title and parameters, in the order of the table."""
    starts = [item.name for item in fields(Settings)]
    cuts = [*(starts.index(name) for name in GROUPS), len(starts)]
    for title, begin, end in zip(GROUPS.values(), cuts, cuts[1:]):
        yield title, list(fields(Settings))[begin:end]


def value_text(value: object) -> str:
    """Return a value as YAML has it."""
    if isinstance(value, (list, tuple)):
        return f'[{", ".join(map(value_text, value))}]'
    if isinstance(value, str):
        return f"'{value}'"
    if isinstance(value, bool):
        return str(value).lower()
    text = _number(value)
    return f'{text}.0' if isinstance(value, float) and '.' not in text else text


def _limits(item: Field[Any], separator: str) -> str:
    """Return the unit and the range, or the choices."""
    meta = item.metadata
    if meta['choices']:
        return separator.join(meta['choices'])
    span = '' if meta['low'] is None else f'{_number(meta["low"])} to {_number(meta["high"])}'
    return ', '.join(text for text in (meta['unit'], span) if text)


def _number(value: Any) -> str:
    """Return a number without an exponent, which YAML would take for a text."""
    return f'{value:.9f}'.rstrip('0').rstrip('.')


if __name__ == '__main__':
    (ROOT / 'config' / 'gr2t.yaml').write_text(yaml_text(), encoding='utf-8')
    (ROOT / 'docs' / 'parameters.md').write_text(markdown_text(), encoding='utf-8')
