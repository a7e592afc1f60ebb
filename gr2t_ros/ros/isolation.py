# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""An environment in which ROS processes of this machine meet each other and nobody else."""
from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from importlib.metadata import PackageNotFoundError, version
import os
import random
import socket

from ..errors import Gr2tError
from ..share import share_directory

# ROS 2 keeps to these on Linux: ports of higher domains may be taken by outgoing connections
_DOMAINS = range(1, 102)


def isolated(environment: Mapping[str, str]) -> dict[str, str]:
    """
    Return an environment with a domain of its own, for this machine only.

    Large messages get through in it: it uses the package's Fast DDS profile.

    :param environment: what is not about ROS is taken from it
    :raises Gr2tError: if all domains are in use
    """
    return {
        **environment,
        'ROS_DOMAIN_ID': str(_free_domain()),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        _profile_variable(): str(share_directory() / 'config' / 'fastdds.xml'),
    }


def _profile_variable() -> str:
    """Return where Fast DDS looks for a profile: it was renamed between jazzy and kilted."""
    jazzy = 7
    try:
        before = int(version('rclpy').partition('.')[0]) <= jazzy
    except PackageNotFoundError:
        before = False
    return 'FASTRTPS_DEFAULT_PROFILES_FILE' if before else 'FASTDDS_DEFAULT_PROFILES_FILE'


def _free_domain() -> int:
    # not the process' seed: two that start at once must choose differently
    domains = random.Random(os.urandom(8)).sample(_DOMAINS, len(_DOMAINS))
    for domain in domains:
        if _is_free(domain):
            return domain
    raise Gr2tError('all ROS domains from 1 to 101 are in use on this machine')


def _is_free(domain: int) -> bool:
    """Tell whether the discovery ports of a domain's first participants can be bound (RTPS)."""
    for participant in range(3):
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
            try:
                probe.bind(('', 7400 + 250 * domain + 10 + 2 * participant))
            except OSError:
                return False
    return True
