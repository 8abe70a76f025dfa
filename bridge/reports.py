"""The reports of bridge, drives, buses and referee about a run: frozen records, the same on the mirrored and the closed path.

`echelon.sim.results` writes them into `summary.json`.  Times are seconds of run time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from echelon.bridge.referee_reports import RefereeReport

EVENTS: Final = 1000
"""How many events of a bus a report keeps"""


@dataclass(frozen=True, slots=True)
class IdentifierReport:
    """The frames with one identifier on one bus."""

    frames: int
    """Frames that the bus carried"""
    lost: int
    """Frames that were lost: the queue was full, the controller was bus-off, or the frame was too old to be sent"""
    destroyed: int
    """Attempts to send that an error destroyed; each was repeated"""
    latency_mean: float
    """Mean time from the queue to the end of the frame [s]"""
    latency_max: float
    """Largest time from the queue to the end of the frame [s]"""
    latency_bound: float | None
    """Worst case by the response-time analysis of the cyclic frames, without errors [s]; None: not known"""

    def plus(self, other: "IdentifierReport") -> "IdentifierReport":
        """Returns this report with the losses of `other`, the report of another process on the same frames, added."""
        return replace(self, lost=self.lost + other.lost)


@dataclass(frozen=True, slots=True)
class BusEvent:
    """An event at a node of a bus, for example `bus-off`; `who` names the node."""

    time: float
    """When it happened [s]"""
    node: int
    """Number of the node on its bus"""
    who: str
    """Name of the node: `bridge`, or that of a drive: its robot, and the wheel if each wheel has a drive of its own"""
    event: str
    """What happened, for example `bus-off`"""


@dataclass(frozen=True, slots=True)
class BusReport:
    """One bus."""

    name: str
    """Name of the bus in the scenario"""
    bitrate: int
    """[bit/s]"""
    load: float
    """Share of the time that the frames took, or would take on a real bus: 1 is a full bus"""
    lost: int = 0
    """Frames that were lost: a queue was full, or its node was bus-off, or the frame was too old to be sent"""
    destroyed: int = 0
    """Attempts to send that an error destroyed; the frame is sent again"""
    events: tuple[BusEvent, ...] = ()
    """The first events, in order of time"""
    identifiers: Mapping[str, IdentifierReport] = field(default_factory=dict)
    """By identifier, three hexadecimal digits"""

    def plus(self, other: "BusReport") -> "BusReport":
        """Returns this report with the losses, events and identifiers of `other` added: the report of another process on the
        same bus."""
        identifiers = dict(self.identifiers)
        for can_id, more in other.identifiers.items():
            identifiers[can_id] = identifiers[can_id].plus(more) if can_id in identifiers else more
        return replace(
            self,
            lost=self.lost + other.lost,
            destroyed=self.destroyed + other.destroyed,
            events=tuple(sorted([*self.events, *other.events], key=lambda event: event.time)[:EVENTS]),
            identifiers=dict(sorted(identifiers.items())),
        )


@dataclass(frozen=True, slots=True)
class ScheduledEvent:
    """An event of the scenario, in words."""

    time: float
    """When it begins [s]"""
    until: float | None
    """When it ends [s]; None: it lasts to the end of the run"""
    what: str
    """What happens, in words"""
    whom: tuple[str, ...]
    """Names of the robots or buses that it concerns"""


@dataclass(frozen=True, slots=True)
class IntrusionReport:
    """Frames with an identifier of the run that no process of the run sent."""

    bus: str
    """Name of the bus in the scenario"""
    sender: str
    """Address of the sender: an IP address for another host, address and port for a program on this one, `another node` on a
    bus whose frames do not say who sent them"""
    id: str
    """Identifier, three hexadecimal digits"""
    frames: int
    """How many"""


@dataclass(frozen=True, slots=True)
class WheelsReport:
    """The commands to one robot's wheels."""

    protocol: str
    """Protocol of its drives"""
    commands: int
    """Periods in which torques were sent"""
    stopped: Mapping[str, int]
    """Torques that were replaced by zero before the bus, by reason"""
    largest: float
    """Largest torque that was sent [N m]"""
    clipped: int = 0
    """Frames in which a torque was cut to the range of the frame"""
    saturated: int = 0
    """Periods in which the robot's own limits acted"""
    repeated: int = 0
    """Second torques for the same period; they made no frame"""
    skipped: int = 0
    """Periods without torques between two periods with torques"""
    refused: Mapping[str, int] = field(default_factory=dict)
    """Frames of the drives that the host refused, by reason"""
    came_up: float | None = None
    """When both wheels first took torque [s]; None: never, or no drive answers"""
    enabled: bool | None = None
    """Whether both wheels take torque at the end of the run; None where no drive answers"""
    fault: str = ""
    """The fault of the drives at the end of the run; empty without one"""


@dataclass(frozen=True, slots=True)
class DriveReport:
    """The virtual drives of a robot."""

    refused: Mapping[str, int]
    """Frames that the drives refused, by reason"""
    lost: int
    """Frames that were lost because a drive's queue was full or its controller was bus-off"""
    temperature: float
    """Temperature of the hotter winding [°C]"""


@dataclass(frozen=True, slots=True)
class DrivesReport:
    """All virtual drives of a run."""

    robots: Mapping[str, DriveReport]
    """By name of the robot"""
    refused: Mapping[str, int]
    """Messages of other processes that the drives refused, by reason"""
    foreign: int = 0
    """Frames on the buses that no process of the run had announced"""
    intrusions: tuple[IntrusionReport, ...] = ()
    """What others sent with identifiers of the drives; `CanReport.with_drives` merges them into the run's"""
    failed: int = 0
    """Frames that a bus did not accept (wall clock)"""
    buses: tuple[BusReport, ...] = ()
    """The drives' reports of the buses; `CanReport.with_drives` merges them into the run's"""


@dataclass(frozen=True, slots=True)
class TorqueTimes:
    """Torques on a wall clock.  Latency is the time from the state that a torque was computed from to the end of its frame
    on the bus [s]."""

    periods: int
    """Number of torques that all robots should send"""
    came: int
    """Number of torques that reached the bridge"""
    in_time: int
    """Number of torques with a latency of less than a torque period"""
    latency_median: float | None
    """[s]; None, here and below, if no torque came"""
    latency_p99: float | None
    """99th percentile [s]"""
    latency_max: float | None
    """Largest [s]"""
    lost_on_links: int
    """Torques that were lost on their links"""


@dataclass(frozen=True, slots=True)
class CanReport:
    """The CAN buses of a run."""

    path: str
    """`mirror` or `closed`"""
    timing: str | None
    """`bits` or `ideal`; None on the mirrored path"""
    url: str
    """URLs of the buses"""
    listen: str
    """The command that shows the frames; empty if no other process can see them"""
    torque_scale: float
    """Torque per bit in frames with torques as whole numbers [N m]"""
    log_start: float
    """Run time at which can.log begins [s]: negative if drives are brought up"""
    frames: int
    """Frames that were made for the buses"""
    load_mean: float
    """Load of the busiest bus"""
    fit: tuple[str, ...]
    """Whether the frames fit, one line for each bus"""
    advice: tuple[str, ...]
    """Changes that would make the frames fit"""
    buses: tuple[BusReport, ...]
    """By bus, in the order of the plan"""
    scheduled: tuple[ScheduledEvent, ...]
    """Events of the scenario"""
    sent: int | None
    """Frames that the buses accepted.  This and the next four fields are None if the bridge gave no report, since it
    was killed."""
    failed: int | None
    """Frames that a bus refused"""
    dropped: int | None
    """Frames given up because the queue of a bus stayed full"""
    log_lost: int | None
    """Lines that are missing in can.log"""
    log_error: str | None
    """The last error of writing can.log"""
    robots: Mapping[str, WheelsReport]
    """By name of the robot"""
    foreign: int = 0
    """Frames that no process of this run had announced"""
    intrusions: tuple[IntrusionReport, ...] = ()
    """What others sent with identifiers of this run.  Frames from other hosts are not used on a multicast bus"""
    refused: Mapping[str, int] = field(default_factory=dict)
    """Messages of other processes that the bridge refused, by reason"""
    drives: DrivesReport | None = None
    """The virtual drives; None without any"""
    torque: TorqueTimes | None = None
    """Latencies of torques; None in virtual time"""
    referee: RefereeReport | None = None
    """What the referee found; None if nothing was judged"""
    messages: int = 0
    """Messages that the bridge sent to recorders and other listeners"""
    wheels_stopped: float | None = None
    """When the bridge stopped the wheels at the end of the run [s]: from then on can.log has the frames of this stop; None if
    the bridge gave no report, since it was killed"""

    @property
    def stopped(self) -> dict[str, int]:
        """Torques that were replaced by zero before the bus, by reason, over all robots; the most frequent reason first."""
        counts: dict[str, int] = {}
        for robot in self.robots.values():
            for reason, count in robot.stopped.items():
                counts[reason] = counts.get(reason, 0) + count
        return dict(sorted(counts.items(), key=lambda item: -item[1]))

    def with_drives(self, drives: DrivesReport) -> "CanReport":
        """Returns this report with the report of the virtual drives added."""
        buses = (
            tuple(bus.plus(more) for bus, more in zip(self.buses, drives.buses, strict=True))
            if drives.buses
            else self.buses
        )
        return replace(
            self,
            drives=replace(drives, buses=(), intrusions=()),
            buses=buses,
            intrusions=self.intrusions + drives.intrusions,
        )


@dataclass(frozen=True, slots=True)
class BridgeProgress:
    """The present state of bridge and drives, for a live table."""

    url: str = ""
    load: float = 0.0
    frames: int = 0
    stopped: str = ""
    faults: tuple[str, ...] = ()
    note: str = ""
    """Why the run waits for a bus; empty if it does not"""


def stopped_text(counts: Sequence[Mapping[str, int]]) -> str:
    """Returns in words how many torques were replaced by zero before the bus, by reason."""
    total: dict[str, int] = {}
    for count in counts:
        for reason, number in count.items():
            total[reason] = total.get(reason, 0) + number
    return ", ".join(f"{number} {reason}" for reason, number in sorted(total.items(), key=lambda item: -item[1]))
