"""Whether the frames of a plan fit their buses in the worst case, and what would make them fit.  Pure."""

from collections.abc import Mapping
from dataclasses import dataclass

from echelon.bridge.protocols.registry import cyclic_of, dbc_messages, make_observer, shared_cyclic, shared_messages
from echelon.bridge.timing.bus_load import worst_case_bits
from echelon.bridge.timing.response_time import Stream, advice, fits, load, response_times
from echelon.plan.plan import Plan


@dataclass(frozen=True, slots=True)
class Fit:
    """The worst case of one bus.

    `load` is its largest load (1 is full).  `responses_ns` are the worst-case response times by identifier; None: no bound, or
    longer than the period.  `advice` says what would make the frames fit, if they do not."""

    bus: str
    bitrate: int
    robots: int
    identifiers: int
    load: float
    responses_ns: Mapping[int, int | None]
    fits: bool
    advice: tuple[str, ...]

    @property
    def lines(self) -> list[str]:
        """A line that says whether the frames fit, then one line for each remedy."""
        speed = f"{self.bitrate / 1e6:g} Mbit/s" if self.bitrate >= 1_000_000 else f"{self.bitrate / 1e3:g} kbit/s"
        what = (
            f"{self.robots} robots, {self.identifiers} cyclic identifiers, {100 * self.load:.3g} % of {speed} at most"
        )
        known = [response for response in self.responses_ns.values() if response is not None]
        late = [f"{can_id:#05x}" for can_id, response in self.responses_ns.items() if response is None]
        if self.fits:
            return [f"{self.bus} fits: {what}; the longest wait is {max(known, default=0) / 1e6:.3g} ms"]
        why = f"; later than their period: {', '.join(late[:4])}{', …' if len(late) > 4 else ''}" if late else ""
        return [f"{self.bus} does not fit: {what}{why}", *(f"  {way}" for way in self.advice)]


def robot_streams(plan: Plan, robot: int) -> list[Stream]:
    """Returns the cyclic frames of a robot and its drives.  On the mirrored path these are the torques alone."""
    one, closed = plan.robots[robot], plan.can.closed
    lengths = {message.frame_id: message.length for message in dbc_messages(one, "robot")}
    return [
        Stream(can_id, period_ns, worst_case_bits(lengths[can_id]))
        for can_id, period_ns in cyclic_of(one, make_observer(one, closed), closed).items()
    ]


def bus_fit(plan: Plan, bus: int) -> Fit:
    """Returns how the frames of a plan fit bus number `bus`."""
    robots = {robot.name: robot_streams(plan, robot.index) for robot in plan.robots if robot.drive.bus == bus}
    lengths = {message.frame_id: message.length for message in shared_messages(plan, bus)}
    shared = [
        Stream(can_id, period_ns, worst_case_bits(lengths[can_id]))
        for on, can_id, period_ns in shared_cyclic(plan)
        if on == bus and plan.can.closed
    ]
    everything = [*shared, *(stream for streams in robots.values() for stream in streams)]
    bitrate = plan.can.buses[bus].bitrate
    return Fit(
        plan.can.buses[bus].name,
        bitrate,
        len(robots),
        len(everything),
        float(load(everything, bitrate)),
        response_times(everything, bitrate),
        fits(everything, bitrate),
        tuple(advice(robots, bitrate, shared)),
    )


def plan_fit(plan: Plan) -> list[Fit]:
    """Returns how the frames of a plan fit each of its buses."""
    return [bus_fit(plan, bus) for bus in range(len(plan.can.buses))]


def describe_fit(plan: Plan) -> list[str]:
    """Returns the result of `plan_fit` as lines of text."""
    return [line for fit in plan_fit(plan) for line in fit.lines]
