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
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.runtime.turns import Turn


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
        _centroid_age(run) if plan.reference == "now" else 0.0,
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


def _centroid_age(run: LinearRun) -> float:
    """Returns the mean age of the robots' positions when the coordinator uses them [s], by the schedule of the run.

    A node that stands for several alike (`likeness.reduced`) has their weight, so this is the mean over all robots."""
    plan, H_ns = run.plan, run.hyperperiod_ns
    periods_ns = {(link.source, link.receiver): link.period_ns for link in plan.links if link.channel in _UP}
    gathers = {
        stage.timed.member: (stage.timed.inputs, acts)
        for stage, acts in zip(run.stages, run.schedule, strict=True)
        if stage.timed.turn is Turn.GATHER
    }

    def taken_ns(member: int, due_ns: int) -> float:
        """Returns the mean instant of the positions in what a member says that is due at an instant."""
        if member not in gathers:
            return due_ns
        inputs, acts = gathers[member]
        begin_ns = due_ns // H_ns * H_ns
        (act,) = acts[due_ns - begin_ns]
        weights = plan.nodes[member - len(plan.robots)].weights
        return sum(
            weight * taken_ns(heard.source, begin_ns + number * periods_ns[heard.source, member])
            for weight, heard, number in zip(weights, inputs, act.used, strict=True)
        ) / sum(weights)

    (act,) = gathers[plan.root.index][1][0]
    return (act.after_ns - taken_ns(plan.root.index, 0)) * 1e-9


_UP = (Channel.STATE, Channel.GROUP_STATE)


def _each_once(instants_ns: Iterable[int]) -> tuple[float, ...]:
    """Returns times in seconds, each once, in ascending order."""
    return tuple(each / 1e9 for each in sorted(set(instants_ns)))
