"""Whether a plan is stable with the periods and delays that it has (docs/architecture.md, 2.7)."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, log

from echelon.controller.late_states import EXTRAPOLATE, PREDICT
from echelon.controller.prediction.gains import PredictionError, linear_gains
from echelon.controller.prediction.likeness import reduced
from echelon.controller.prediction.linear_run import CHANNELS, LinearRun, ruled_links, untreated
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.messages import Channel
from echelon.plan.plan import LinkPlan, Plan


@dataclass(frozen=True, slots=True)
class Analysis:
    """The predictions about a plan, by its linear run (`prediction.linear_run`)."""

    delays: dict[Channel, tuple[float, ...]]
    """For each channel the delays of its links in the scenario [s], each once, in ascending order"""
    acceleration_periods: tuple[float, ...]
    """The acceleration periods of the nodes [s], each once, in ascending order"""
    torque_periods: tuple[float, ...]
    """The torque periods of the robots [s], each once, in ascending order"""
    hyperperiod: float
    """Period of the root [s]; all other periods divide it"""
    radius: float
    """Spectral radius of the run's map over one hyperperiod: in the long run errors are multiplied by it in each hyperperiod"""
    centroid_age: float
    """Mean age over the robots of their positions when the coordinator uses them [s].  A formation that moves with a constant
    velocity has a steady error of velocity times this age, which is not an instability"""

    @property
    def settles(self) -> bool:
        """True if errors decay in the long run."""
        return self.radius < 1

    @property
    def time_constant(self) -> float:
        """The time in which errors decay, or grow, by the factor e in the long run [s]: hyperperiod/|ln radius|."""
        return inf if self.radius == 1 else self.hyperperiod / abs(log(self.radius)) if self.radius > 0 else 0.0


def analyse(plan: Plan) -> Analysis:
    """Returns the predictions about a plan.

    Raises PredictionError if no exact prediction is possible: the law is not linear, links lose messages or have varying
    delays, messages are older than their timeout when they would be used, or delays are so long that the map is too large."""
    for block in plan.blocks:
        linear_gains(plan, block)
    if found := untreated(plan):
        raise PredictionError(f"{describe_untreated(found)}: only constant delays without loss are treated")
    run = LinearRun(reduced(plan)[0])
    radius = spectral_radius(run.map())
    links = {channel: ruled_links(plan, channel) for channel in CHANNELS}
    there = [channel for channel in CHANNELS if links[channel]]
    return Analysis(
        {channel: _each_once(link.delay_min_ns for link in links[channel]) for channel in there},
        _each_once(node.period_ns for node in plan.nodes),
        _each_once(robot.torque_period_ns for robot in plan.robots),
        run.hyperperiod_ns * 1e-9,
        radius,
        _centroid_age(plan) if plan.reference == "now" else 0.0,
    )


def describe_untreated(links: Sequence[LinkPlan]) -> str:
    """Returns in words how many links of which channels cannot be treated, and why; `links` are such links."""

    def like(link: LinkPlan) -> str:
        low, high = link.delay_min_ns / 1e9, link.delay_max_ns / 1e9
        loss = [f"lose {100 * link.loss:g} % of their messages"] if link.loss else []
        delays = [f"have delays from {low:g} to {high:g} s"] if high > low else []
        policy = [f"have the policy {link.policy}"] if link.policy in (EXTRAPOLATE, PREDICT) else []
        return " and ".join([*loss, *(["have delays that vary"] if link.delays else delays), *policy])

    found = Counter((link.channel.name.lower(), like(link)) for link in links)
    return ", ".join(f"{count} {channel} links {what}" for (channel, what), count in found.items())


def _centroid_age(plan: Plan) -> float:
    """Returns the mean age of the robots' positions when the coordinator uses them [s]."""
    links = {(link.source, link.receiver): link for link in plan.links if link.channel in _UP}
    ages = []
    for robot in plan.robots:
        member, age_ns, now_ns = robot.index, 0, 0
        while (parent := plan.formation[member].parent) is not None:
            link = links[member, parent]
            used_ns = -(-(now_ns + link.delay_min_ns) // link.period_ns) * link.period_ns
            age_ns, now_ns, member = used_ns, used_ns, parent
        ages.append(age_ns)
    return sum(ages) / len(ages) * 1e-9


_UP = (Channel.STATE, Channel.GROUP_STATE)


def _each_once(instants_ns: Iterable[int]) -> tuple[float, ...]:
    """Returns times in seconds, each once, in ascending order."""
    return tuple(each / 1e9 for each in sorted(set(instants_ns)))
