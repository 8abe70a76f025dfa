"""What bridge, drives, buses and referee report of a run: frozen records, the same for every way of the torques.

`echelon.sim.results` renders them as JSON in `summary.json`.  Times are in seconds of run time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

EVENTS: Final = 1000
"""Events kept of a bus"""


@dataclass(frozen=True, slots=True)
class IdentifierReport:
    """The frames with one identifier on one bus."""

    frames: int
    """Carried by the bus"""
    lost: int
    """Lost: no room in a queue, a controller off its bus, or too old to be sent"""
    destroyed: int
    """Attempts that an error destroyed; each was sent again"""
    latency_mean: float
    """From the queue to the end of the frame [s]"""
    latency_max: float
    latency_bound: float | None
    """Worst case by response-time analysis of the cyclic frames, without errors [s]; None: none is known"""

    def plus(self, other: "IdentifierReport") -> "IdentifierReport":
        """Returns the report with what another part of the run lost of the same frames."""
        return replace(self, lost=self.lost + other.lost)


@dataclass(frozen=True, slots=True)
class BusEvent:
    """Something that happened to a node of a bus, e.g. `bus-off`."""

    time: float
    node: int
    who: str
    event: str


@dataclass(frozen=True, slots=True)
class BusReport:
    """One bus."""

    name: str
    bitrate: int
    load: float
    """Share of the time that its frames took, or would take on a real bus"""
    lost: int = 0
    destroyed: int = 0
    events: tuple[BusEvent, ...] = ()
    identifiers: Mapping[str, IdentifierReport] = field(default_factory=dict)
    """By identifier, three hexadecimal digits"""

    def plus(self, other: "BusReport") -> "BusReport":
        """Returns the report with what another part of the run knows of the same bus: its identifiers, what it lost, what
        happened to its nodes."""
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
    """An event of the scenario, for people."""

    time: float
    until: float | None
    """None: for good"""
    what: str
    whom: tuple[str, ...]
    """Robots, or buses"""


@dataclass(frozen=True, slots=True)
class WheelsReport:
    """A robot's torques on their way to its wheels."""

    protocol: str
    commands: int
    """Periods in which torques were sent"""
    stopped: Mapping[str, int]
    """Torques that became zero before the bus, by reason"""
    largest: float
    """Largest torque that was sent [N m]"""
    clipped: int = 0
    """Frames in which a torque was cut to the range of the frame"""
    saturated: int = 0
    """Periods in which the robot's own limits acted"""
    repeated: int = 0
    """Torques for a period that had its frame: no frame"""
    skipped: int = 0
    """Periods without torques between two that had them"""
    refused: Mapping[str, int] = field(default_factory=dict)
    """Frames of the drives that were refused, by reason"""
    came_up: float | None = None
    """When both wheels first took torque [s]; None: never, or no drive answers"""
    enabled: bool | None = None
    """At the end of the run; None where no drive answers"""
    fault: str = ""
    """What a drive reported to be wrong at the end; empty if nothing was"""


@dataclass(frozen=True, slots=True)
class DriveReport:
    """The virtual drives of a robot."""

    refused: Mapping[str, int]
    """Frames that they refused, by reason"""
    lost: int
    """Frames that their queues had no room for"""
    temperature: float
    """Of the hotter winding [°C]"""


@dataclass(frozen=True, slots=True)
class DrivesReport:
    """All virtual drives of a run."""

    robots: Mapping[str, DriveReport]
    refused: Mapping[str, int]
    """Messages of other processes that were refused, by reason"""
    foreign: int = 0
    """Frames on their buses that nobody of the run had announced"""
    failed: int = 0
    """Frames that a bus did not take (wall clock)"""
    buses: tuple[BusReport, ...] = ()
    """What the drives know of each bus; part of the run's `CanReport.buses`"""


@dataclass(frozen=True, slots=True)
class TorqueTimes:
    """Torques on a wall clock: how many came to the bus, and how long after the state they were computed from [s]."""

    periods: int
    """Torques that there were to be"""
    came: int
    in_time: int
    """Within a torque period of the state"""
    latency_median: float | None
    latency_p99: float | None
    latency_max: float | None
    lost_on_links: int


@dataclass(frozen=True, slots=True)
class FindingReport:
    """Something that breaks the contract of a bus."""

    time: float
    bus: str
    id: str
    """Identifier, three hexadecimal digits"""
    kind: str
    text: str
    robot: str
    """Empty where it is nobody's"""


@dataclass(frozen=True, slots=True)
class TimingReport:
    """When the frames of an identifier came [s]; None where there were too few."""

    frames: int
    period_mean: float | None = None
    period_min: float | None = None
    period_max: float | None = None
    jitter: float | None = None
    """Standard deviation of the periods"""


@dataclass(frozen=True, slots=True)
class RefereeReport:
    """What the referee saw and found."""

    frames: int
    unknown: int
    """Frames with identifiers that no robot of the plan uses"""
    kinds: Mapping[str, int]
    """Findings by kind"""
    findings: tuple[FindingReport, ...]
    """The first ones, in full"""
    identifiers: Mapping[str, TimingReport]
    """By bus and identifier, `can0:101`"""
    source: str = "can.log"
    """What it judged: `can.log`, or `bus` if it listened itself"""


@dataclass(frozen=True, slots=True)
class CanReport:
    """The CAN buses of a run."""

    path: str
    """`mirror` or `closed`"""
    timing: str | None
    """`bits` or `ideal`; None where torque is mirrored"""
    url: str
    """Where frames could be heard"""
    listen: str
    """What to type to hear them; empty if nobody else can"""
    torque_scale: float
    """Of frames with torques in whole numbers [N m per bit]"""
    log_start: float
    """Run time of the first instant of can.log [s]: before 0 where drives are brought up"""
    frames: int
    load_mean: float
    """Of the busiest bus"""
    fit: tuple[str, ...]
    """Whether the frames fit each bus, in one line each"""
    advice: tuple[str, ...]
    """What would make them fit"""
    buses: tuple[BusReport, ...]
    scheduled: tuple[ScheduledEvent, ...]
    sent: int | None
    """None, here and below, where nobody knows: the run was killed and recovered"""
    failed: int | None
    """Frames that a bus refused"""
    dropped: int | None
    """Frames given up because a bus's queue stayed full"""
    log_lost: int | None
    """Lines that can.log lacks"""
    log_error: str | None
    robots: Mapping[str, WheelsReport]
    foreign: int = 0
    """Frames that nobody of this run had announced"""
    refused: Mapping[str, int] = field(default_factory=dict)
    """Messages of other processes that were refused, by reason"""
    drives: DrivesReport | None = None
    torque: TorqueTimes | None = None
    referee: RefereeReport | None = None
    messages: int = 0
    """Messages that the bridge sent to those who watch"""

    @property
    def stopped(self) -> dict[str, int]:
        """Torques that became zero before the bus, by reason, over all robots; the most frequent reason first."""
        counts: dict[str, int] = {}
        for robot in self.robots.values():
            for reason, count in robot.stopped.items():
                counts[reason] = counts.get(reason, 0) + count
        return dict(sorted(counts.items(), key=lambda item: -item[1]))

    def with_drives(self, drives: DrivesReport) -> "CanReport":
        """Returns the report with that of the virtual drives, whose buses are the same."""
        buses = (
            tuple(bus.plus(more) for bus, more in zip(self.buses, drives.buses, strict=True))
            if drives.buses
            else self.buses
        )
        return replace(self, drives=replace(drives, buses=()), buses=buses)


@dataclass(frozen=True, slots=True)
class BridgeProgress:
    """How bridge and drives stand, for a live table."""

    url: str = ""
    load: float = 0.0
    frames: int = 0
    stopped: str = ""
    faults: tuple[str, ...] = ()
    note: str = ""
    """Why the run stands still, if a bus is the reason"""


def stopped_text(counts: Sequence[Mapping[str, int]]) -> str:
    """Returns how many torques became zero before the bus, by reason, in words."""
    total: dict[str, int] = {}
    for count in counts:
        for reason, number in count.items():
            total[reason] = total.get(reason, 0) + number
    return ", ".join(f"{number} {reason}" for reason, number in sorted(total.items(), key=lambda item: -item[1]))
