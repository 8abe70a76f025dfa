"""The scene of a run for ROS viewers: transforms, odometry, wheels, and markers of robots and centroids."""

from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.messages import STATE_FIELDS, Values
from echelon.plan.plan import NodePlan, Plan
from echelon.sim.recording import ros
from echelon.sim.recording.ros_definitions import ros_name
from echelon.sim.results.desired import Desired

Array = NDArray[np.float64]

TF, MARKERS, DESIRED, JOINT_STATES = "/tf", "/markers", "/desired", "/joint_states"
DESIRED_POINTS: Final = 500
"""Points of the line that shows the desired trajectory"""
GREY: Final = (0.6, 0.6, 0.6, 1.0)
COLORS: Final = (
    (0.12, 0.47, 0.71, 1.0),
    (1.0, 0.5, 0.05, 1.0),
    (0.17, 0.63, 0.17, 1.0),
    (0.84, 0.15, 0.16, 1.0),
    (0.58, 0.4, 0.74, 1.0),
    (0.55, 0.34, 0.29, 1.0),
    (0.89, 0.47, 0.76, 1.0),
    (0.09, 0.75, 0.81, 1.0),
)
"""Colours of the groups, used in turn; the root of a formation with groups is grey."""


class Scene:
    """The latest states of all robots, and the ROS messages that show them.

    `states` has for each robot its latest state (`STATE_FIELDS`), which the recorder replaces; before the first one a robot
    stands at its start."""

    def __init__(self, plan: Plan) -> None:
        self.states: list[Values] = []
        for robot in plan.robots:
            state = np.zeros(len(STATE_FIELDS))
            state[:2], state[STATE_FIELDS.index("theta")] = robot.start, robot.heading
            self.states.append(state)
        self.topics = {TF: "tf2_msgs/TFMessage", MARKERS: "visualization_msgs/MarkerArray"}
        self.topics |= {JOINT_STATES: "sensor_msgs/JointState"}
        names = [ros_name(robot.path) for robot in plan.robots]
        self.topics |= {f"/{name}/odom": "nav_msgs/Odometry" for name in names}
        """Types of the messages that `messages` returns, by topic"""
        self._arm = np.array([robot.arm for robot in plan.robots])
        self._offset = np.array([robot.offset for robot in plan.robots])
        self._wheel_radius = np.array([robot.wheel_radius for robot in plan.robots])
        self._means = np.zeros((len(plan.nodes), len(plan.robots)))
        for row, node in enumerate(plan.nodes):
            self._means[row, node.first_robot : node.first_robot + node.robots] = 1 / node.robots
        self._transforms = ros.transforms(names)
        self._joints = ros.joint_state([f"{name}/{side}" for name in names for side in ("right", "left")])
        self._odometry = {f"/{name}/odom": ros.odometry(name) for name in names}
        self._markers = _markers(plan)

    def messages(self, time_ns: int) -> list[tuple[str, bytes]]:
        """Returns topic and bytes of each message that shows the latest states at `time_ns`.  Values that are not finite are
        written as they are."""
        states = np.array(self.states)
        x, y, vx, vy, theta, v, omega, _, _, tau_right, tau_left = states.T[:11]
        with np.errstate(all="ignore"):
            cos, sin = np.cos(theta), np.sin(theta)
            poses = np.stack([x, y, np.sin(theta / 2), np.cos(theta / 2)], axis=1)
            arrows = poses.copy()
            arrows[:, 0] -= self._offset * cos  # an arrow begins at the axle, but the position is the reference point's
            arrows[:, 1] -= self._offset * sin
            spheres = np.zeros((len(self._means), 4))
            spheres[:, :2] = self._means @ poses[:, :2]
            spheres[:, 3] = 1.0
            turning = self._arm * omega
            wheels = np.stack([v + turning, v - turning], axis=1) / self._wheel_radius[:, None]
            twists = np.stack([cos * vx + sin * vy, cos * vy - sin * vx, omega], axis=1)
        efforts = np.stack([tau_right, tau_left], axis=1)
        odometry = np.concatenate([poses, twists], axis=1)
        return [
            (TF, self._transforms.encode(time_ns, poses.ravel())),
            (MARKERS, self._markers.encode(time_ns, np.concatenate([arrows, spheres]).ravel())),
            (JOINT_STATES, self._joints.encode(time_ns, np.concatenate([wheels, efforts]).ravel())),
            *(
                (topic, self._odometry[topic].encode(time_ns, row))
                for topic, row in zip(self._odometry, odometry, strict=True)
            ),
        ]


def desired(plan: Plan) -> bytes:
    """Returns the marker array that shows the whole desired trajectory of the centroid as a line.  It is written once, at time
    0."""
    places = Desired(plan).sample(np.linspace(0.0, plan.duration_ns / 1e9, DESIRED_POINTS))[:, 0]
    points = [(x, y) for x, y in places.tolist() if isfinite(x) and isfinite(y)]
    layout = ros.markers(1)
    ros.add_marker(layout, "desired centroid", 0, ros.LINE_STRIP, (_size(plan) / 4, 0.0, 0.0), GREY, points)
    return ros.Template(layout).encode(0, np.empty(0))


def _size(plan: Plan) -> float:
    """Returns the diameter of a centroid's sphere [m]: the track of a typical robot."""
    return float(np.median([2 * robot.arm for robot in plan.robots]))


def _markers(plan: Plan) -> ros.Template:
    """Returns the encoder of the markers: an arrow for each robot and a sphere for each node, each group in its colour."""
    layout = ros.markers(len(plan.robots) + len(plan.nodes))
    by_index = {node.index: node for node in plan.nodes}
    for robot in plan.robots:
        scale = (abs(robot.offset) + robot.arm, 2 * robot.arm, 2 * robot.wheel_radius)
        ros.add_marker(layout, "robots", robot.index, ros.ARROW, scale, _color(plan, by_index[robot.parent]))
    for node in plan.nodes:
        size = _size(plan)
        ros.add_marker(layout, "centroids", node.index, ros.SPHERE, (size, size, size), _color(plan, node))
    return ros.Template(layout)


def _color(plan: Plan, node: NodePlan) -> tuple[float, float, float, float]:
    return (
        GREY if node.parent is None and len(plan.nodes) > 1 else COLORS[(node.index - len(plan.robots)) % len(COLORS)]
    )
