"""The recorder: it writes a run as an MCAP file that ROS viewers can open (docs/architecture.md, 6.2).

All times in the file are run times, so that the same run gives the same bytes.
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
from echelon.sim.recording.ros_definitions import ros_name
from echelon.sim.recording.scene import DESIRED, Scene, desired

SCENARIO: Final = "scenario.toml"
"""The name of the attachment that holds the effective scenario."""
FRAMES, LINKS = "/can/frames", "/links"
"""Topics of frames and of counts of links.  With several buses, the topics of frames have their names: `/can/can1/frames`."""
NULLS: Final = "/nulls"
"""Topic of null messages: which source sent one, on which channel, and its number"""


class Recorder:
    """Writes the messages of a run, and standard ROS messages that show the run in viewers.  Messages must come in order of
    time, then source."""

    def __init__(
        self,
        path: Path,
        plan: Plan,
        scenario_toml: str,
        metadata: dict[str, str],
        part_files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Creates the file at `path`.  Raises OSError if it cannot be created.

        The scenario and the texts `part_files` (by name) become attachments; `metadata`, such as versions, become metadata."""
        self.null_messages = 0
        """Number of null messages"""
        self._plan = plan
        self._scene = Scene(plan)
        topics, known = routes(plan)
        topics |= self._scene.topics | {DESIRED: "visualization_msgs/MarkerArray"}
        self._frame_topics = frame_topics(plan)
        topics |= dict.fromkeys(self._frame_topics, "can_msgs/Frame")
        topics |= {LINKS: "echelon_msgs/LinkStatistics", NULLS: "echelon_msgs/NullMessage"}
        self._numbers = {topic: number for number, topic in enumerate(topics, 1)}
        self._routes = {
            key: (self._numbers[topic], splice.size, splice.encode) for key, (topic, splice) in known.items()
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
        """Why writing stopped; None if it did not."""
        return self._file.failure

    def record(self, message: Message) -> None:
        """Writes a message.  Raises ValueError if it has not the number of values that its channel has in the plan."""
        raw = message.values.tobytes()
        self.null_messages += not raw
        if self._file.failure is not None:
            return
        if message.time_ns != self._now:
            self._advance(message.time_ns)
        source, channel = message.source, message.channel
        if not raw:
            null = ros.null_message(self._head, source, channel, message.sequence)
            self._file.add(self._numbers[NULLS], self.null_messages - 1, self._now, null)
            return
        number, size, encode = self._routes[16 * source + channel]
        if len(raw) != size:
            name = self._plan.all_roles[source].name
            raise ValueError(f"{channel.name} of {name} has {len(raw) // 8} values; it must have {size // 8}")
        self._file.add(number, message.sequence, self._now, encode(self._head, raw))
        if channel is Channel.STATE:
            self._scene.states[source] = message.values

    def record_frame(self, timed: TimedFrame) -> None:
        """Writes a CAN frame.  Frames from before run time 0 are not written; they are in can.log."""
        time_ns, bus, _, (can_id, data, remote) = timed
        if self._file.failure is None and time_ns >= 0 and bus < len(self._frames):
            head = self._head if time_ns == self._now else ros.stamp(time_ns)
            frame = ros.can_frame(head, can_id, data, remote)
            self._file.add(self._numbers[self._frame_topics[bus]], self._frames[bus], time_ns, frame)
            self._frames[bus] += 1

    def record_links(self, time_ns: int, links: Sequence[LinkCounts]) -> None:
        """Writes the counts of links at an instant."""
        members = self._plan.all_roles
        for counts in links if self._file.failure is None else ():
            name = f"{members[counts.source].name} to {members[counts.receiver].name}"
            data = ros.link_statistics(time_ns, counts, name)
            self._file.add(self._numbers[LINKS], self._link_messages, time_ns, data)
            self._link_messages += 1

    def flush_if_due(self, monotonic_ns: int) -> None:
        """Writes to disk what was recorded so far, so that a kill does not cost it; should be called at least ten times a
        second of wall time `monotonic_ns`."""
        self._file.flush_if_due(monotonic_ns)

    def close(self) -> None:
        """Writes the rest of the file.  A second call does nothing."""
        self._show()
        self._file.close()

    def _advance(self, time_ns: int) -> None:
        """Begins a new instant: all messages of the last one have come, and the scene of it is written if that is due."""
        if time_ns > self._now:
            self._show()
        self._now = time_ns
        self._head = ros.stamp(time_ns)

    def _show(self) -> None:
        """Writes the ROS messages that show the instant that ends, if `display_period_ns` have passed since the last time."""
        if self._now < self._next_display or self._file.failure is not None:
            return
        for topic, data in self._scene.messages(self._now):
            self._file.add(self._numbers[topic], self._shown, self._now, data)
        self._shown += 1
        period = self._plan.display_period_ns
        self._next_display = (self._now // period + 1) * period


def routes(plan: Plan) -> tuple[dict[str, str], dict[int, tuple[str, ros.Splice]]]:
    """Returns the types of all topics by topic, and the topic and encoder of each kind of message by 16 * source + channel."""
    topics: dict[str, str] = {}
    found: dict[int, tuple[str, ros.Splice]] = {}

    def add(channel: Channel, source: int, topic: str, kind: str, splice: ros.Splice) -> None:
        topics[topic] = f"echelon_msgs/{kind}"
        found[16 * source + channel] = (topic, splice)

    if plan.bridge is not None:
        for robot in plan.robots:
            add(Channel.TORQUE, robot.index, torque_topic(robot.path), "WheelTorque", ros.wheel_torque())
        add(Channel.WHEELS, plan.bridge.index, "/wheels", "Wheels", ros.wheels(2 * len(plan.robots)))
    for robot in plan.robots:
        add(Channel.STATE, robot.index, state_topic(robot.path), "RobotState", ros.robot_state())
    for node in plan.nodes:
        prefix = f"/{ros_name(node.path)}/".replace("//", "/")
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
    return topics, found


def frame_topics(plan: Plan) -> list[str]:
    """Returns the topics of CAN frames, one for each bus in the order of the plan."""
    if len(plan.can.buses) == 1:
        return [FRAMES]
    return [f"/can/{ros_name(bus.name)}/frames" for bus in plan.can.buses]


def state_topic(path: str) -> str:
    """Returns the topic of the state of the robot with this path in the tree."""
    return f"/{ros_name(path)}/state"


def torque_topic(path: str) -> str:
    """Returns the topic of the wanted torques of the robot with this path, on a closed torque path."""
    return f"/{ros_name(path)}/torque"
