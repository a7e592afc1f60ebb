# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A recording played into the node: `ros2 launch gr2t_ros replay.launch.py bag:=BAG`."""
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription


def generate_launch_description():
    """Start what live.launch.py starts, with all its arguments, and the player."""
    live = get_package_share_directory('gr2t_ros') + '/launch/live.launch.py'
    return LaunchDescription([
        DeclareLaunchArgument('bag', description='Folder or file of the recording'),
        DeclareLaunchArgument(
            'rate', default_value='1.0', description='Times the recorded speed'),
        DeclareLaunchArgument(
            'delay', default_value='3.0', description='Seconds before the recording starts'),
        IncludeLaunchDescription(PythonLaunchDescriptionSource(live)),
        ExecuteProcess(
            cmd=[
                'ros2', 'bag', 'play', LaunchConfiguration('bag'),
                '--rate', LaunchConfiguration('rate'), '--delay', LaunchConfiguration('delay')],
            output='screen'),
    ])
