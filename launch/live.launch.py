# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node on a live depth camera: `ros2 launch gr2t_ros live.launch.py --show-args`."""
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description():
    """Start gr2t_node, and RViz where asked."""
    config = get_package_share_directory('gr2t_ros') + '/config/'
    camera = LaunchConfiguration('camera')
    arguments = [
        DeclareLaunchArgument(
            'preset', default_value='gr2t',
            description='Parameter file of the folder config, without .yaml'),
        DeclareLaunchArgument(
            'camera', default_value='/camera/camera', description='Namespace of the camera'),
        DeclareLaunchArgument(
            'depth_topic', default_value=[camera, '/depth/image_rect_raw'],
            description='Depth images: 16UC1 or mono16 (millimetres) or 32FC1 (metres)'),
        DeclareLaunchArgument(
            'camera_info_topic', default_value=[camera, '/depth/camera_info'],
            description='Their camera_info'),
        DeclareLaunchArgument(
            'pose_source', default_value='tf',
            description='tf, or pose, pose_with_covariance, odometry, transform (a topic)'),
        DeclareLaunchArgument(
            'pose_topic', default_value='pose', description='Poses, where not from tf'),
        DeclareLaunchArgument(
            'world_frame', default_value='',
            description='Frame of the map; empty: the root of the tf tree above the camera'),
        DeclareLaunchArgument(
            'snapshot_directory', default_value='~/gr2t_snapshots',
            description='Folder of the PLY snapshots'),
        DeclareLaunchArgument('rviz', default_value='false', description='Also start RViz'),
    ]
    # what follows the preset wins over it
    values = ('pose_source', 'world_frame', 'snapshot_directory')
    node = Node(
        package='gr2t_ros', executable='gr2t_node', name='gr2t', output='screen',
        parameters=[
            [config, LaunchConfiguration('preset'), '.yaml'],
            {name: ParameterValue(LaunchConfiguration(name), value_type=str)
             for name in values},
        ],
        remappings=[
            ('depth/image', LaunchConfiguration('depth_topic')),
            ('depth/camera_info', LaunchConfiguration('camera_info_topic')),
            ('pose', LaunchConfiguration('pose_topic')),
        ])
    rviz = Node(
        package='rviz2', executable='rviz2', output='screen',
        arguments=['-d', config + 'gr2t.rviz'],
        condition=IfCondition(LaunchConfiguration('rviz')))
    return LaunchDescription([*arguments, node, rviz])
