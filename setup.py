"""What colcon and pip install; lint and type settings are in pyproject.toml."""
from glob import glob

from setuptools import find_packages, setup

NAME = 'gr2t_ros'

# As wheels these exist for two distributions; the others come with an installed ROS 2.
ROS_PACKAGES = (
    'rclpy', 'std-msgs', 'sensor-msgs', 'geometry-msgs', 'std-srvs', 'nav-msgs',
    'visualization-msgs', 'diagnostic-msgs', 'rmw-fastrtps-cpp',
)

TEST_PACKAGES = ['hypothesis>=6.100', 'mcap>=1.1', 'pytest>=8.0', 'pytransform3d>=3.5']

setup(
    name=NAME,
    version='0.1.0',
    description='Live likelihood-coloured meshes from depth images and camera poses, on a CPU.',
    license='Apache-2.0',
    maintainer='The gr2t_ros developers',
    maintainer_email='gr2t_ros@example.org',
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'tools/viewer/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    entry_points={
        'console_scripts': [
            'gr2t = gr2t_ros.tools.cli:main',
            'gr2t_node = gr2t_ros.ros:main',
        ],
    },
    # The lower bounds let it run on the numpy 1 that humble and jazzy are built with.
    install_requires=[
        'backports.zstd>=1.0; python_version < "3.14"',
        'lz4>=4.0',
        'matplotlib>=3.5',
        'numba>=0.57',
        'numpy>=1.21',
        'opencv-python-headless>=4.5',
        'plyfile>=0.8',
        'PyYAML>=5.4',
        'rosbags>=0.11.9',
        'scipy>=1.8',
        'tqdm>=4.57',
        'trimesh>=4.0',
    ],
    extras_require={
        'kilted': [f'ros-kilted-{name}' for name in ROS_PACKAGES],
        'jazzy': [f'ros-jazzy-{name}' for name in ROS_PACKAGES],
        'simulation': ['embreex>=2.17'],
        'decimation': ['fast-simplification>=0.1.5'],
        # colcon test runs pytest because it is named in this one.
        'test': TEST_PACKAGES,
        'dev': [
            *TEST_PACKAGES,
            'colcon-common-extensions>=0.3',
            'fast-simplification>=0.1.5',
            'mypy>=1.11',
            'ruff>=0.6',
            'types-PyYAML',
        ],
        # Its wheels are for Linux, from Python 3.10 on.
        'fuzz': ['atheris>=2.3'],
        # Other people's readers of our PLY files; large.
        'peers': ['open3d>=0.18', 'pymeshlab>=2023.12'],
    },
)
