"""Definitions of the ROS 2 messages that this package writes, as `ros2msg` schemas.

Source: the .msg files of common_interfaces, rcl_interfaces (builtin_interfaces) and geometry2 (tf2_msgs), Jazzy.
Those of semslam_msgs are this package's own: no common type holds an object's outline together with its class and pose.
"""

from __future__ import annotations

_DEFINITIONS = {
    "builtin_interfaces/Time": """\
int32 sec
uint32 nanosec
""",
    "std_msgs/Header": """\
builtin_interfaces/Time stamp
string frame_id
""",
    "geometry_msgs/Vector3": """\
float64 x
float64 y
float64 z
""",
    "geometry_msgs/Point": """\
float64 x
float64 y
float64 z
""",
    "geometry_msgs/Point32": """\
float32 x
float32 y
float32 z
""",
    "geometry_msgs/Polygon": """\
Point32[] points
""",
    "geometry_msgs/PolygonStamped": """\
std_msgs/Header header
Polygon polygon
""",
    "geometry_msgs/Quaternion": """\
float64 x 0
float64 y 0
float64 z 0
float64 w 1
""",
    "geometry_msgs/Pose": """\
Point position
Quaternion orientation
""",
    "geometry_msgs/PoseWithCovariance": """\
Pose pose
float64[36] covariance
""",
    "geometry_msgs/PoseStamped": """\
std_msgs/Header header
Pose pose
""",
    "geometry_msgs/Twist": """\
Vector3 linear
Vector3 angular
""",
    "geometry_msgs/TwistWithCovariance": """\
Twist twist
float64[36] covariance
""",
    "geometry_msgs/Transform": """\
Vector3 translation
Quaternion rotation
""",
    "geometry_msgs/TransformStamped": """\
std_msgs/Header header
string child_frame_id
Transform transform
""",
    "sensor_msgs/RegionOfInterest": """\
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
""",
    "sensor_msgs/Image": """\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
""",
    "sensor_msgs/CompressedImage": """\
std_msgs/Header header
string format
uint8[] data
""",
    "sensor_msgs/CameraInfo": """\
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
RegionOfInterest roi
""",
    "sensor_msgs/Imu": """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
""",
    "nav_msgs/Odometry": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
""",
    "tf2_msgs/TFMessage": """\
geometry_msgs/TransformStamped[] transforms
""",
    "semslam_msgs/FloorObject": """\
# One object as it stands on the floor or on a piece of furniture.
uint32 id
string class_name
string style
# Middle of what it stands on, x towards its front, in the frame of the list.
geometry_msgs/Pose pose
# Outline of its projection on the floor, in the frame of the list, counter-clockwise.
geometry_msgs/Polygon footprint
# From what it stands on to its top, metres.
float64 height
""",
    "semslam_msgs/FloorObjects": """\
std_msgs/Header header
FloorObject[] objects
""",
}
"""Text by short type name. A field type without a package is of the same package."""

_RULE = "=" * 80


def ros2_schema(type_name: str) -> bytes:
    """The whole schema of `package/msg/Type`: its definition, then that of every type it uses, each once."""
    package, _, name = type_name.split("/")
    root = f"{package}/{name}"
    parts = [_DEFINITIONS[root]]
    parts += [f"{_RULE}\nMSG: {used}\n{_DEFINITIONS[used]}" for used in _used(root, [])]
    return "".join(parts).encode()


def _used(type_name: str, found: list[str]) -> list[str]:
    """Types below `type_name`, in order of first use."""
    for line in _DEFINITIONS[type_name].splitlines():
        base = line.split()[0].partition("[")[0]
        used = base if "/" in base else f"{type_name.partition('/')[0]}/{base}"
        if used in _DEFINITIONS and used not in found:
            found.append(used)
            _used(used, found)
    return found
