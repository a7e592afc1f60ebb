# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node on a live depth camera: `ros2 launch gr2t_ros live.launch.py --show-args`."""
from dataclasses import fields

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from gr2t_ros.settings import parsed, Settings
from launch import LaunchDescription

# preset: namespace of its camera, depth images, their camera_info
TOPICS = {
    'realsense_d400': ('/camera/camera', 'depth/image_rect_raw', 'depth/camera_info'),
    'kinect_v1': ('/kinect', 'depth/image_raw', 'depth/camera_info'),
    'azure_kinect': ('', 'depth/image_raw', 'depth/camera_info'),
    'zed': ('/zed/zed_node', 'depth/depth_registered', 'depth/camera_info'),
}


def generate_launch_description():
    """Start gr2t_node, and RViz where asked."""
    arguments = {
        'preset': ('gr2t', f'{", ".join(TOPICS)}, tabletop_scan, room_scan; gr2t: the defaults'),
        'params_file': ('', 'A parameter file of your own; wins over the preset'),
        'camera': ('', 'Namespace of the camera; empty: as its driver names it'),
        'depth_topic': ('', 'Depth images; empty: as the preset\'s driver names them'),
        'camera_info_topic': ('', 'Their camera_info; empty: likewise'),
        'pose_topic': ('pose', 'Poses, where pose_source is not tf'),
        'use_sim_time': ('false', 'Take the time from /clock'),
        'rviz': ('false', 'Also start RViz'),
    }
    parameters = {
        item.name: ('', f'Parameter; wins over the files. {item.metadata["help"]}')
        for item in fields(Settings)}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=description)
          for name, (default, description) in {**arguments, **parameters}.items()),
        OpaqueFunction(function=nodes),
    ])


def nodes(context):
    """Return what is to be started, once the arguments have their values."""
    def value(name):
        return LaunchConfiguration(name).perform(context)

    config = get_package_share_directory('gr2t_ros') + '/config/'
    camera, depth, info = TOPICS.get(value('preset'), TOPICS['realsense_d400'])
    camera = value('camera').rstrip('/') or camera
    files = [f'{config}{value("preset")}.yaml', value('params_file')]
    given = {item.name: parsed(item.name, value(item.name))
             for item in fields(Settings) if value(item.name)}
    for name, item in given.items():
        if isinstance(item, str):  # one that looks like a number would become one
            given[name] = ParameterValue(item, value_type=str)
        elif isinstance(item, tuple):
            given[name] = list(item)
    given['use_sim_time'] = value('use_sim_time').lower() == 'true'
    node = Node(
        package='gr2t_ros', executable='gr2t_node', name='gr2t', output='screen',
        parameters=[*filter(None, files), given],  # the later win
        remappings=[
            ('depth/image', value('depth_topic') or f'{camera}/{depth}'),
            ('depth/camera_info', value('camera_info_topic') or f'{camera}/{info}'),
            ('pose', value('pose_topic')),
        ])
    if value('rviz').lower() != 'true':
        return [node]
    frame = value('world_frame')
    return [node, Node(
        package='rviz2', executable='rviz2', output='screen',
        arguments=['-d', config + 'gr2t.rviz', *(('-f', frame) if frame else ())])]
