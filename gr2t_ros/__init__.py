# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Likelihood-coloured meshes from depth images and camera poses, on a CPU."""
