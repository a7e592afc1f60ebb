# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""gr2t_node in its own process, fed over DDS from another one."""
from array import array
from pathlib import Path
import re
import signal
import time

import numpy as np
import pytest

from gr2t_ros.core.view import View
from gr2t_ros.io.formats import read
from gr2t_ros.tools.recorder import CAMERA_INFO_TOPIC, DEPTH_TOPIC, OPTICAL_FRAME, record

rclpy = pytest.importorskip('rclpy', reason='ROS 2 is not installed')
pytest.importorskip('tf2_msgs', reason='tf2_msgs is not installed')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import PoseArray, PoseStamped  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue  # noqa: E402
from rcl_interfaces.srv import (  # noqa: E402
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
)
from rclpy.qos import qos_profile_sensor_data, QoSProfile  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from rclpy.time import Time  # noqa: E402
from ros_for_tests import Isolation, NodeProcess, Observer, plane_views, wait_until  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402
from visualization_msgs.msg import Marker, MarkerArray  # noqa: E402

from gr2t_ros.ros.outputs import outputs_profile  # noqa: E402

FRAMES = 6
FLAT = 0.01  # m from the plane; beside a border kernels are one-sided


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a plane."""
    path = tmp_path_factory.mktemp('bags') / 'plane'
    assert record(path, plane_views(FRAMES)) == FRAMES
    return path


def test_map_from_a_played_bag(
    isolation: Isolation, observer: Observer, bag: Path, tmp_path: Path
) -> None:
    """Mesh, points and snapshot show the plane; reset empties them, pause stops them."""
    with NodeProcess(isolation, tmp_path, '-p', 'publish_rate:=10.0') as node:
        arrays = observer.collect(MarkerArray, '/gr2t/mesh', outputs_profile(10))
        clouds = observer.collect(PointCloud2, '/gr2t/points', outputs_profile(10))
        states = observer.collect(DiagnosticArray, '/diagnostics', QoSProfile(depth=10))
        images = [
            observer.collect(kind, f'/gr2t/{topic}', outputs_profile(10)) for kind, topic in (
                (Image, 'depth/image'), (CameraInfo, 'depth/camera_info'),
                *((Image, f'{name}/image') for name in ('likelihood', 'sigma', 'confidence')))]
        assert not observer.call(Trigger, 'save_snapshot').success

        isolation.play(bag)
        last_stamp = plane_views(FRAMES)[-1].stamp_ns
        observer.spin_until(
            lambda: clouds and Time.from_msg(
                deserialize_message(clouds[-1], PointCloud2).header.stamp
            ).nanoseconds == last_stamp, 'a cloud with the last image')

        assert 'the map begins, in the frame map' in node.log
        _check_cloud(deserialize_message(clouds[-1], PointCloud2))
        observer.spin_until(lambda: all(images), 'the images')
        _check_images(*(
            deserialize_message(messages[0], kind)
            for kind, messages in zip((Image, CameraInfo, Image, Image, Image), images)))

        def reported() -> bool:
            """Tell whether the newest status knows the last image, and the work is done."""
            array = deserialize_message(states[-1], DiagnosticArray) if states else None
            return bool(array) and array.status[2].values[0].value == str(FRAMES) and all(
                item.level == DiagnosticStatus.OK for item in array.status)

        observer.spin_until(reported, 'diagnostics')
        _check_diagnostics(deserialize_message(states[-1], DiagnosticArray))
        assert re.search(r'^publish +[1-9]', observer.call(Trigger, 'timing').message, re.M)
        markers = _markers(arrays)
        for marker in markers.values():
            _check_marker(marker)
            assert len(marker.points) > 100
        fused = observer.collect(MarkerArray, '/gr2t/fused_mesh', outputs_profile(10))
        next_views = observer.collect(PoseArray, '/gr2t/next_views', outputs_profile(10))
        attention = observer.collect(PointCloud2, '/gr2t/attention', outputs_profile(10))
        observer.spin_until(lambda: fused and next_views and attention, 'the fused map')
        for marker in _markers(fused).values():
            _check_marker(marker)
        # the plane goes on beyond the images; it is seen from above
        array = deserialize_message(next_views[-1], PoseArray)
        assert array.header.frame_id == 'map'
        assert array.poses and all(pose.position.z > 0 for pose in array.poses)
        assert deserialize_message(attention[-1], PointCloud2).width > 10
        answer = observer.call(Trigger, 'save_snapshot')
        assert answer.success, answer.message
        path = Path(answer.message.partition(': ')[0])
        mesh = read(path)
        assert path.parent == node.snapshots
        assert np.abs(mesh.vertices[:, 2]).max() < FLAT
        assert f'{len(mesh.faces)} faces' in answer.message
        assert f'likelihood {mesh.attributes["likelihood"].min():.3g} to' in answer.message
        assert mesh.attributes['views'].max() == len(markers)

        # someone who comes late gets everything
        late = observer.collect(MarkerArray, '/gr2t/mesh', outputs_profile(10))
        observer.spin_until(lambda: _markers(late).keys() == markers.keys(), 'all markers again')

        # colours may show something else, at once
        arrays.clear()
        by_sigma = Parameter(name='color_by', value=ParameterValue(
            type=ParameterType.PARAMETER_STRING, string_value='sigma'))
        answer = observer.call(SetParameters, 'set_parameters', parameters=[by_sigma])
        assert answer.results[0].successful

        def recoloured() -> bool:
            """Tell whether all are there again in other colours; the old ones may come first."""
            again = _markers(arrays)
            return again.keys() == markers.keys() and all(
                marker.points == markers[number].points
                and marker.colors != markers[number].colors for number, marker in again.items())

        observer.spin_until(recoloured, 'other colours')

        arrays.clear()
        fused.clear()
        assert observer.call(Trigger, 'reset').success
        observer.spin_until(
            lambda: all(messages and deserialize_message(
                messages[-1], MarkerArray).markers[0].action == Marker.DELETEALL
                for messages in (arrays, fused)), 'messages that delete the markers')
        assert not observer.call(Trigger, 'save_snapshot').success

        assert observer.call(SetBool, 'pause', data=True).success
        isolation.play(bag)
        assert not observer.call(Trigger, 'save_snapshot').success
        assert observer.call(SetBool, 'pause', data=False).success
        isolation.play(bag)
        observer.spin_until(
            lambda: observer.call(Trigger, 'save_snapshot').success, 'a snapshot after the pause')

        assert node.stop() == 0
        assert re.search(
            rf'frames: {3 * FRAMES} received, {2 * FRAMES} integrated, {FRAMES} dropped '
            rf'\(paused {FRAMES}\), 0 waiting', node.log)
        assert len(list(node.snapshots.iterdir())) >= 2


def _markers(arrays: list[bytes]) -> dict[int, Marker]:
    """Return the markers as a viewer has them after these messages."""
    markers: dict[int, Marker] = {}
    for data in arrays:
        for marker in deserialize_message(data, MarkerArray).markers:
            markers[marker.id] = marker
    return markers


def _check_marker(marker: Marker) -> None:
    assert (marker.action, marker.type) == (Marker.ADD, Marker.TRIANGLE_LIST)
    assert marker.header.frame_id == 'map'
    assert len(marker.points) == len(marker.colors) > 0
    assert len(marker.points) % 3 == 0
    assert max(abs(point.z) for point in marker.points) < FLAT
    assert marker.color.a == 1.0
    assert all(colour.a == 1.0 for colour in marker.colors)
    assert marker.scale.x == marker.scale.y == marker.scale.z == 1.0


def _check_diagnostics(array: DiagnosticArray) -> None:
    assert [item.name for item in array.status] == ['gr2t: inputs', 'gr2t: camera', 'gr2t: map']
    assert {item.level for item in array.status} == {DiagnosticStatus.OK}, array
    values = {item.key: item.value for status in array.status for item in status.values}
    assert values['received'] == values['integrated'] == values['views'] == str(FRAMES)
    assert int(values['keyframes']) > 1 and int(values['blocks']) > 10
    assert float(values['memory (MB)']) > 50
    assert 0 <= float(values['worker load (%)']) <= 100
    assert {'received (Hz)', 'integrated (Hz)', 'waiting rays', 'waiting for a pose'} <= {*values}


def _check_cloud(cloud: PointCloud2) -> None:
    assert [field.name for field in cloud.fields] == [
        'x', 'y', 'z', 'rgb', 'likelihood', 'sigma', 'confidence']
    assert cloud.header.frame_id == 'map'
    points = np.frombuffer(cloud.data, np.float32).reshape(-1, cloud.point_step // 4)
    assert len(points) == cloud.width * cloud.height > 100
    assert np.abs(points[:, 2]).max() < FLAT
    assert (points[:, 4] > 0).all()


def _check_images(depth: Image, info: CameraInfo, *of_depths: Image) -> None:
    assert all(message.header == depth.header for message in (info, *of_depths))
    assert depth.header.frame_id == OPTICAL_FRAME
    stamp_ns = Time.from_msg(depth.header.stamp).nanoseconds
    view, = (view for view in plane_views(FRAMES) if view.stamp_ns == stamp_ns)
    assert (info.width, info.height) == (view.camera.width, view.camera.height)
    z, likely, sigma, confidence = (
        np.frombuffer(item.data, np.float32).reshape(info.height, info.width)
        for item in (depth, *of_depths))
    found = np.isfinite(z)
    assert found.mean() > 0.9
    assert all(np.isnan(image[~found]).all() for image in (likely, sigma, confidence))
    assert (likely[found] > 0).all()
    assert 0 < np.median(sigma[found]) < FLAT
    assert 0.3 < np.median(confidence[found]) < 1
    fx, _, cx, _, fy, cy, *_ = info.k
    v, u = np.nonzero(found)
    points = np.column_stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(u))]) * z[found][:, None]
    height = points @ view.T_world_camera[2, :3] + view.T_world_camera[2, 3]
    assert np.abs(height).max() < FLAT


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_with_a_snapshot(
    isolation: Isolation, bag: Path, tmp_path: Path, number: signal.Signals
) -> None:
    with NodeProcess(isolation, tmp_path, '-p', 'snapshot_on_exit:=true') as node:
        isolation.play(bag)
        assert node.stop(number) == 0
        snapshots = list(node.snapshots.iterdir())
        assert len(snapshots) == 1
        assert len(read(snapshots[0]).faces) > 100
        assert f'snapshot: {snapshots[0]}' in node.log


def test_sigint_in_the_middle_of_a_snapshot(
    isolation: Isolation, observer: Observer, bag: Path, tmp_path: Path
) -> None:
    """Whole files only, and exit code 0."""
    with NodeProcess(isolation, tmp_path) as node:
        isolation.play(bag)
        client = observer.node.create_client(Trigger, '/gr2t/save_snapshot')
        observer.spin_until(client.service_is_ready, 'the service')
        answers = [client.call_async(Trigger.Request()) for _ in range(8)]
        observer.spin_until(answers[0].done, 'the first snapshot')
        assert node.stop() == 0
        for path in node.snapshots.iterdir():
            assert len(read(path).faces) > 100
        for item in answers:
            if item.done():
                answer = item.result()
                assert answer.success or 'told to stop' in answer.message


def test_a_map_outlives_a_node_that_is_killed(
    isolation: Isolation, observer: Observer, bag: Path, tmp_path: Path
) -> None:
    """The next one loads it, publishes it, and goes on."""
    with NodeProcess(isolation, tmp_path, '-p', 'map_period:=0.01') as node:
        assert 'there is no map in' in observer.call(Trigger, 'load_map').message
        isolation.play(bag)
        observer.spin_until(
            lambda: f'{FRAMES} views' in observer.call(Trigger, 'save_map').message, 'all views')
        node.stop(signal.SIGKILL)
    # a service of the dead would take the question, and never answer
    observer.spin_until(
        lambda: 'gr2t' not in observer.node.get_node_names(), 'the dead node to be forgotten')
    path, = node.snapshots.glob('*.gr2t')
    with NodeProcess(isolation, tmp_path, '-p', 'publish_rate:=10.0') as node:
        answer = observer.call(Trigger, 'load_map')
        assert answer.success and answer.message.startswith(f'{path}: {FRAMES} views')
        clouds = observer.collect(PointCloud2, '/gr2t/points', outputs_profile(10))
        observer.spin_until(lambda: clouds, 'the loaded map as points')
        _check_cloud(deserialize_message(clouds[-1], PointCloud2))
        isolation.play(bag)
        observer.spin_until(
            lambda: f'{2 * FRAMES} views' in observer.call(Trigger, 'save_map').message,
            'more views')
        assert len(list(node.snapshots.glob('*.gr2t'))) == 2
        elsewhere = Parameter(name='snapshot_directory', value=ParameterValue(
            type=ParameterType.PARAMETER_STRING, string_value='/'))
        answer = observer.call(SetParameters, 'set_parameters', parameters=[elsewhere])
        assert 'is read at the start' in answer.results[0].reason
        assert node.stop() == 0


def test_a_signal_before_any_input(isolation: Isolation, tmp_path: Path) -> None:
    with NodeProcess(isolation, tmp_path) as node:
        assert node.stop(signal.SIGTERM) == 0
        assert 'frames: 0 received' in node.log
        assert not node.snapshots.exists()


@pytest.mark.parametrize(('arguments', 'words'), [
    (('-p', 'depth_max:=-1.0'), 'depth_max must lie in [0, 1000] m'),
    (('-p', 'depth_mx:=3.0'), 'unknown parameter depth_mx; did you mean depth_max?'),
    (('-p', 'ray_stride:=two'), 'ray_stride must be a whole number'),
    (('-p', 'pose_source:=gps'), 'pose_source must be one of tf, pose'),
    (('--params-file', '/nowhere.yaml'), '/nowhere.yaml'),
])
def test_a_parameter_that_cannot_be_used(
    isolation: Isolation, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    """One line says which, and the exit code is 2."""
    with NodeProcess(isolation, tmp_path, *arguments, ready=False) as node:
        assert node.wait() == 2
        assert words in node.log
        assert node.log.count('\n') == 1


def test_all_parameters_are_described(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    """`ros2 param describe` shows help, unit and range; what cannot change says so."""
    with NodeProcess(isolation, tmp_path, '-p', 'depth_max:=4') as node:
        names = observer.call(ListParameters, 'list_parameters').result.names
        assert {'depth_max', 'world_frame', 'publish_rate', 'snapshot_on_exit'} <= set(names)
        described = observer.call(
            DescribeParameters, 'describe_parameters', names=['depth_max', 'pose_source'])
        depth_max, pose_source = described.descriptors
        assert depth_max.description == 'Depths above are invalid. [m]'
        assert depth_max.floating_point_range[0].to_value == 1000.0
        assert 'odometry' in pose_source.additional_constraints
        assert not depth_max.read_only and pose_source.read_only

        def change(name: str, **value: object) -> str:
            """Return why a parameter did not change."""
            new = Parameter(name=name, value=ParameterValue(**value))
            result = observer.call(SetParameters, 'set_parameters', parameters=[new]).results[0]
            assert result.successful == (not result.reason)
            return result.reason

        whole, text = ParameterType.PARAMETER_INTEGER, ParameterType.PARAMETER_STRING
        assert change('depth_max', type=whole, integer_value=3) == ''
        assert change('colour_map', type=text, string_value='viridis') == ''
        node.wait_for("parameter colour_map is now 'viridis'")
        assert 'parameter depth_max is now 3.0' in node.log
        assert 'must lie in [0, 1000] m, not -1' in change(
            'depth_max', type=whole, integer_value=-1)
        assert 'must be below depth_max (3 m)' in change(
            'depth_min', type=whole, integer_value=4)
        assert change('density', type=text, string_value='exact') == (
            'parameter density is read at the start: restart the node with -p density:=exact')
        values = observer.call(GetParameters, 'get_parameters', names=['depth_max', 'density'])
        assert values.values[0].double_value == 3.0
        assert values.values[1].string_value == 'voxel'
        assert '* depth_max 4.0 m' in node.log


def test_poses_from_a_topic(isolation: Isolation, observer: Observer, tmp_path: Path) -> None:
    """Best-effort publishers and PoseStamped, no tf at all."""
    publish = {
        kind: observer.node.create_publisher(kind, topic, qos_profile_sensor_data)
        for kind, topic in (
            (Image, DEPTH_TOPIC), (CameraInfo, CAMERA_INFO_TOPIC), (PoseStamped, '/where'))}
    with NodeProcess(
            isolation, tmp_path, '-p', 'pose_source:=pose', '-r', 'pose:=/where',
            '-p', 'max_wait_for_pose:=10.0') as node:
        def delivered() -> bool:
            """Publish all; what is sent at best effort is lost until the two sides have met."""
            for view in plane_views(FRAMES):
                for message in _messages(view):
                    publish[type(message)].publish(message)
            return bool(observer.call(Trigger, 'save_snapshot').success)

        observer.spin_until(delivered, 'a snapshot')
        path = max(node.snapshots.iterdir())
        assert np.abs(read(path).vertices[:, 2]).max() < FLAT
        assert node.stop() == 0


def _messages(view: View) -> tuple[PoseStamped, CameraInfo, Image]:
    """Return a view as live messages, its depth in millimetres."""
    pose, info, image = PoseStamped(), CameraInfo(), Image()
    for message, frame in ((pose, 'lab'), (info, 'camera'), (image, 'camera')):
        message.header.frame_id = frame
        message.header.stamp = Time(nanoseconds=view.stamp_ns).to_msg()
    place, turn = pose.pose.position, pose.pose.orientation
    place.x, place.y, place.z = map(float, view.T_world_camera[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(
        float, Rotation.from_matrix(view.T_world_camera[:3, :3]).as_quat())
    camera = view.camera
    info.height, info.width = camera.height, camera.width
    info.k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    image.height, image.width = view.depth.shape
    image.encoding, image.step = '16UC1', 2 * image.width
    image.data = array('B', np.round(1000 * view.depth).astype('<u2').tobytes())
    return pose, info, image


def test_images_without_poses_are_counted_and_explained(
    isolation: Isolation, tmp_path: Path
) -> None:
    bag = tmp_path / 'plane'
    record(bag, plane_views(3))
    with NodeProcess(
            isolation, tmp_path, '-p', 'world_frame:=odom',
            '-p', 'max_wait_for_pose:=0.2') as node:
        isolation.play(bag)
        node.wait_for('[unconnected_frames: said once')
        wait_until(lambda: 'odom' in node.log, 'the frame\'s name')
        assert node.stop() == 0
        assert '3 dropped (unconnected_frames 3)' in node.log


def test_services_answer_while_frames_come(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    bag = tmp_path / 'plane'
    record(bag, plane_views(600))  # longer than any machine takes
    with NodeProcess(isolation, tmp_path) as node:
        player = isolation.run('gr2t_ros.ros.bag_player', bag)
        try:
            observer.spin_until(
                lambda: observer.call(Trigger, 'save_snapshot').success, 'a first snapshot')
            for _ in range(3):
                began = time.monotonic()
                assert observer.call(Trigger, 'save_snapshot').success
                assert observer.call(Trigger, 'reset').success
                assert observer.call(SetBool, 'pause', data=False).success
                print(f'three services answered in {time.monotonic() - began:.2f} s')
                observer.spin_until(
                    lambda: observer.call(Trigger, 'save_snapshot').success, 'a frame')
            assert player.poll() is None, 'the recording was too short for this test'
        finally:
            player.kill()
            player.wait()
        assert node.stop() == 0
