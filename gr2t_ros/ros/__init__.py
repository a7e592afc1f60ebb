# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node. Only this package imports rclpy."""
from __future__ import annotations

import sys


def main() -> int:
    """Run gr2t_node; without ROS 2 say so in a line."""
    try:
        from . import node
    except ImportError as error:
        sys.stderr.write(
            f'gr2t_node: ROS 2 is not here ({error}): source its setup file, or install the '
            'wheels with `make venv`; `gr2t replay` works without it\n')
        return 2
    return node.main()
