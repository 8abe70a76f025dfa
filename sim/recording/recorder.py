"""The recorder: a run as an MCAP file that any ROS viewer opens.

Every time in the file is the run's own, so the same run gives the same bytes.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

from echelon.bridge.frame_message import TimedFrame
from echelon.messages import Channel, Message
from echelon.plan.layout import NodeLayout, length
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.recording import ros
from echelon.sim.recording.mcap_writer import ChunkedFile
from echelon.sim.recording.scene import DESIRED, Scene, desired

SCENARIO: Final = "scenario.toml"
"""The name of the attachment that holds the effective scenario."""
FRAMES, LINKS = "/can/frames", "/links"
"""Frames of the only bus; of several, the name of each stands between: `/can/can1/frames`."""


class Recorder:
    """Writes a run's messages, and what shows them, as they come: in the order of time, then source."""

    def __init__(
        self,
        path: Path,
        plan: Plan,
        scenario_toml: str,
        metadata: dict[str, str],
        part_files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Begins the file at `path`; raises OSError if it cannot be made.  The scenario goes into it as an attachment
        and `metadata` (versions and the like) as metadata; the texts `part_files` as attachments, too, by their names."""
        self.null_messages = 0
        """How many messages said nothing; they are not written."""
        self._plan = plan
        self._scene = Scene(plan)
        topics, routes = _routes(plan)
        topics |= self._scene.topics | {DESIRED: "visualization_msgs/MarkerArray"}
        self._frame_topics = frame_topics(plan)
        topics |= dict.fromkeys(self._frame_topics, "can_msgs/Frame")
        topics |= {LINKS: "echelon_msgs/LinkStatistics"}
        self._numbers = {topic: number for number, topic in enumerate(topics, 1)}
        self._routes = {
            key: (self._numbers[topic], splice.size, splice.encode) for key, (topic, splice) in routes.items()
        }
        attachments = {name: text.encode() for name, text in {SCENARIO: scenario_toml, **part_files}.items()}
        self._file = ChunkedFile(path, attachments, metadata, topics)
        self._file.add(self._numbers[DESIRED], 0, 0, desired(plan))
        self._now = -1
        self._head = b""
        self._next_display = self._shown = 0
        self._link_messages = 0
        self._frames = [0] * len(self._frame_topics)

    @property
    def failure(self) -> str | None:
        """Why nothing is written any more, or None."""
        return self._file.failure

    def record(self, message: Message) -> None:
        """Takes a message.  Raises ValueError if it has not as many values as the plan says."""
        raw = message.values.tobytes()
        if not raw:
            self.null_messages += 1
            return
        if self._file.failure is not None:
            return
        if message.time_ns != self._now:
            self._advance(message.time_ns)
        source, channel = message.source, message.channel
        number, size, encode = self._routes[16 * source + channel]
        if len(raw) != size:
            name = self._plan.all_roles[source].name
            raise ValueError(f"{channel.name} of {name} has {len(raw) // 8} values; it must have {size // 8}")
        self._file.add(number, message.sequence, self._now, encode(self._head, raw))
        if channel is Channel.STATE:
            self._scene.states[source] = message.values

    def record_frame(self, timed: TimedFrame) -> None:
        """Takes a CAN frame; what came before run time 0, when drives were brought up, is in can.log alone."""
        time_ns, bus, _, (can_id, data, remote) = timed
        if self._file.failure is None and time_ns >= 0 and bus < len(self._frames):
            frame = ros.can_frame(ros.stamp(time_ns), can_id, data, remote)
            self._file.add(self._numbers[self._frame_topics[bus]], self._frames[bus], time_ns, frame)
            self._frames[bus] += 1

    def record_links(self, time_ns: int, links: Sequence[LinkCounts]) -> None:
        """Takes the counts of links at an instant."""
        members = self._plan.all_roles
        for counts in links if self._file.failure is None else ():
            name = f"{members[counts.source].name} to {members[counts.receiver].name}"
            data = ros.link_statistics(time_ns, counts, name)
            self._file.add(self._numbers[LINKS], self._link_messages, time_ns, data)
            self._link_messages += 1

    def flush_if_due(self, monotonic_ns: int) -> None:
        """To be called ten times a second or more: what was recorded until then outlives a kill."""
        self._file.flush_if_due(monotonic_ns)

    def close(self) -> None:
        """Writes what is left.  May be called twice."""
        self._show()
        self._file.close()

    def _advance(self, time_ns: int) -> None:
        """Ends an instant: all its messages have come, so it can be shown."""
        if time_ns > self._now:
            self._show()
        self._now = time_ns
        self._head = ros.stamp(time_ns)

    def _show(self) -> None:
        """Shows the instant that ends if its turn has come."""
        if self._now < self._next_display or self._file.failure is not None:
            return
        for topic, data in self._scene.messages(self._now):
            self._file.add(self._numbers[topic], self._shown, self._now, data)
        self._shown += 1
        period = self._plan.display_period_ns
        self._next_display = (self._now // period + 1) * period


def _routes(plan: Plan) -> tuple[dict[str, str], dict[int, tuple[str, ros.Splice]]]:
    """Returns the types of the topics of messages, and by 16 source + channel the topic and encoder of each message."""
    topics: dict[str, str] = {}
    routes: dict[int, tuple[str, ros.Splice]] = {}

    def add(channel: Channel, source: int, topic: str, kind: str, splice: ros.Splice) -> None:
        topics[topic] = f"echelon_msgs/{kind}"
        routes[16 * source + channel] = (topic, splice)

    if plan.bridge is not None:
        for robot in plan.robots:
            add(Channel.TORQUE, robot.index, torque_topic(robot.path), "WheelTorque", ros.wheel_torque())
        add(Channel.WHEELS, plan.bridge.index, "/wheels", "Wheels", ros.wheels(2 * len(plan.robots)))
    for robot in plan.robots:
        add(Channel.STATE, robot.index, state_topic(robot.path), "RobotState", ros.robot_state())
    for node in plan.nodes:
        prefix = f"/{ros.ros_name(node.path)}/".replace("//", "/")
        layout = NodeLayout.of(plan, node)
        if node.parent is not None:
            state = layout.state
            encoder = ros.group_state(length(state.rates), length(state.positions))
            add(Channel.GROUP_STATE, node.index, prefix + "state", "GroupState", encoder)
        if (reference := layout.reference) is not None:
            encoder = ros.reference(*map(length, (reference.accelerations, reference.rates, reference.forces)))
            add(Channel.REFERENCE, node.index, prefix + "reference", "Reference", encoder)
        if (command := layout.command) is not None:
            add(Channel.COMMAND, node.index, prefix + "command", "Command", ros.command(length(command.accelerations)))
    return topics, routes


def frame_topics(plan: Plan) -> list[str]:
    """Returns the topics of the frames, bus by bus."""
    if len(plan.can.buses) == 1:
        return [FRAMES]
    return [f"/can/{ros.ros_name(bus.name)}/frames" for bus in plan.can.buses]


def state_topic(path: str) -> str:
    """Returns the topic of a robot's state."""
    return f"/{ros.ros_name(path)}/state"


def torque_topic(path: str) -> str:
    """Returns the topic of the torques that a robot wants, on a closed torque path."""
    return f"/{ros.ros_name(path)}/torque"
