"""Definitions of the ROS 2 message types in a recording, in the format ros2msg, and ROS names."""

from typing import Final

from echelon.messages import GROUP_FIELDS, STATE_FIELDS, TORQUE_FIELDS

_HEADER: Final = "std_msgs/Header header\n"
_MARKER_KINDS: Final = (
    *("ARROW", "CUBE", "SPHERE", "CYLINDER", "LINE_STRIP", "LINE_LIST", "CUBE_LIST", "SPHERE_LIST", "POINTS"),
    *("TEXT_VIEW_FACING", "MESH_RESOURCE", "TRIANGLE_LIST"),
)
_MARKER_CONSTANTS: Final = "".join(f"int32 {name}={value}\n" for value, name in enumerate(_MARKER_KINDS))
DEFINITIONS: Final = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": _HEADER + "string child_frame_id\ngeometry_msgs/Transform transform\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "sensor_msgs/CompressedImage": _HEADER + "string format\nuint8[] data\n",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v\n",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data\n",
    "visualization_msgs/Marker": (
        _MARKER_CONSTANTS + "int32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n" + _HEADER + "string ns\n"
        "int32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\n"
        "std_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool frame_locked\n"
        "geometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n"
        "sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\nstring text\n"
        "string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers\n",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "nav_msgs/Odometry": _HEADER + "string child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist\n",
    "sensor_msgs/JointState": _HEADER + "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
    "can_msgs/Frame": _HEADER + "uint32 id\nbool is_rtr\nbool is_extended\nbool is_error\nuint8 dlc\nuint8[8] data\n",
    "echelon_msgs/RobotState": _HEADER + "".join(f"float64 {name}\n" for name in STATE_FIELDS),
    "echelon_msgs/GroupState": _HEADER
    + "".join(f"float64 {name}\n" for name in GROUP_FIELDS)
    + "float64[] error_rates\nfloat64[] positions\n",
    "echelon_msgs/Reference": _HEADER + "float64[] accelerations\nfloat64[] error_rates\nfloat64[] forces\n",
    "echelon_msgs/Command": _HEADER + "float64[] accelerations\n",
    "echelon_msgs/WheelTorque": _HEADER + "".join(f"float64 {name}\n" for name in TORQUE_FIELDS),
    "echelon_msgs/Wheels": _HEADER + "float64[] torques\n",
    "echelon_msgs/NullMessage": _HEADER + "uint32 source\nuint8 channel\nuint64 sequence\n",
    "echelon_msgs/LinkStatistics": _HEADER + "uint32 source\nuint32 receiver\nuint8 channel\nstring name\nuint64 sent\n"
    "uint64 delivered\nuint64 lost\nuint64 in_flight\nuint64 used\nuint64 held\n"
    "float64 age_mean_ns\nint64 age_max_ns\nint64 age_p50_ns\nint64 age_p95_ns\nint64 age_p99_ns\nuint64 duplicates\n",
}
"""Message definitions by name, without the middle part `msg`.  Types of fields are written with their package."""


def ros_name(path: str) -> str:
    """Returns a path of names as a valid ROS name, in which hyphens are not allowed: `g-1/r2` becomes `g_1/r2`."""
    return path.replace("-", "_")


def schema_name(name: str) -> str:
    """Returns a type's name with the middle part `msg`: `nav_msgs/Odometry` becomes `nav_msgs/msg/Odometry`."""
    return name.replace("/", "/msg/")


def schema_text(name: str) -> str:
    """Returns a definition followed by those of all types in it: the format ros2msg."""
    parts, found, waiting = [DEFINITIONS[name]], {name}, [name]
    while waiting:
        for line in DEFINITIONS[waiting.pop(0)].splitlines():
            used = line.split(" ")[0].partition("[")[0]
            if used in DEFINITIONS and used not in found:
                found.add(used)
                waiting.append(used)
                parts.append(f"MSG: {used}\n{DEFINITIONS[used]}")
    return f"{'=' * 80}\n".join(parts)
