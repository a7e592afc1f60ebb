# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The method: numpy in, numpy out. No ROS, no files, no printing."""
from . import compiled as compiled  # before the first kernel
