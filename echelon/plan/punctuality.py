"""Which messages are always sent at their nominal instants (docs/architecture.md, 4.6).

A robot sends its state at the beginning of each period.  A time-driven node sends at the beginning of its period, too.  An
event-driven node does so if whatever it waits for is there at once: if all links that it hears are ideal, and their sources
are punctual.  Where all messages are punctual and all links are ideal, the run is the one of time-driven nodes.
"""

from collections.abc import Sequence
from dataclasses import replace

from echelon.messages import Channel
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import NodePlan


def with_punctuality(links: Sequence[LinkPlan], nodes: Sequence[NodePlan]) -> list[LinkPlan]:
    """Returns the links with `LinkPlan.punctual`.  `nodes` are in the order of their indices: children before parents."""
    by_ends = {(link.source, link.receiver, link.channel): link for link in links}
    late: set[tuple[int, Channel]] = set()
    """Sources and channels whose messages may be sent after their nominal instants"""

    def is_prompt(source: int, receiver: int, channel: Channel) -> bool:
        return by_ends[source, receiver, channel].ideal and (source, channel) not in late

    for node in nodes:
        first_node = nodes[0].index
        channels = [Channel.STATE if child < first_node else Channel.GROUP_STATE for child in node.children]
        heard = [is_prompt(child, node.index, channel) for child, channel in zip(node.children, channels, strict=True)]
        if node.event_driven and not all(heard):
            late |= {(node.index, channel) for channel in (Channel.GROUP_STATE, Channel.REFERENCE, Channel.COMMAND)}
    for node in reversed(nodes):
        if node.event_driven and node.parent is not None and not is_prompt(node.parent, node.index, Channel.REFERENCE):
            late |= {(node.index, channel) for channel in (Channel.REFERENCE, Channel.COMMAND)}
    return [replace(link, punctual=(link.source, link.channel) not in late) for link in links]
