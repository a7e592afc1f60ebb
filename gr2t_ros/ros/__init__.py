# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 node. Only this package imports rclpy."""
