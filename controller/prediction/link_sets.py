"""The sets of links whose largest delay `echelon analyse` computes: by channel, by layer and channel, by robot, by group, and
all together.

A link lies between a member and its parent, so it belongs to the parent's node, and its *layer* is that of the node's shape
(docs/architecture.md, 2.3).  A *link class* is a layer and a channel: `intra state` are the states that robots send to leaders.
On a closed torque path the wanted torques are a class of their own."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from echelon.controller.prediction.likeness import likeness
from echelon.controller.prediction.linear_run import CHANNELS, Edges, edge_of, edges_of, ruled_links
from echelon.messages import Channel
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan

Kind = Literal["class", "channel", "layer", "all", "group", "robot"]
LAYERS = ("intra", "middle", "inter")


@dataclass(frozen=True, slots=True)
class LinkSet:
    """Some links of a plan whose messages are late together."""

    kind: Kind
    name: str
    """What links they are, in words"""
    layer: str | None
    """The layer of all of them; None if there are several"""
    channel: Channel | None
    """The channel of all of them; None if there are several"""
    edges: Edges
    like: tuple[str, ...] = ()
    """For robots and groups: the names of all robots or groups with which it is the same"""


def link_sets(plan: Plan) -> list[LinkSet]:
    """Returns the sets of links of a plan, the classes first.  Of robots and groups that are alike there is one set."""
    links = [link for channel in CHANNELS for link in ruled_links(plan, channel)]
    layers = {link: _layer(plan, link) for link in map(edge_of, links)}
    found: list[LinkSet] = []

    def add(kind: Kind, name: str, edges: Edges, like: tuple[str, ...] = ()) -> None:
        if edges:
            of, carry = {layers[one] for one in edges}, {one[2] for one in edges}
            layer, channel = of.pop() if len(of) == 1 else None, carry.pop() if len(carry) == 1 else None
            found.append(LinkSet(kind, name, layer, channel, edges, like))

    for layer in (*LAYERS, "robot"):
        for channel in CHANNELS:
            of_both = frozenset(one for one, where in layers.items() if where == layer and one[2] is channel)
            add("class", f"{layer} {channel.name.lower()}", of_both)
    for channel in CHANNELS:
        add("channel", channel.name.lower(), edges_of(plan, channel))
    for layer in LAYERS:
        add("layer", f"{layer}, both ways", frozenset(one for one, where in layers.items() if where == layer))
    add("all", "all links", frozenset(layers))
    for kind, names, member in _members(plan):
        own = plan.formation[member]
        up = frozenset(one for one in layers if member in one[:2] and own.parent in one[:2])
        if kind == "robot":
            for one in sorted(up, key=lambda edge: edge[2].value):
                add(kind, f"{own.name} {one[2].name.lower()}", frozenset((one,)), names)
            add(kind, f"{own.name}, both ways", up, names)
        else:
            inside = frozenset(one for one in layers if member in one[:2] and own.parent not in one[:2])
            add(kind, f"{own.name}, to its members", inside, names)
            add(kind, f"{own.name}, to its parent", up, names)
    return found


def _members(plan: Plan) -> Iterator[tuple[Kind, tuple[str, ...], int]]:
    """Yields groups, then robots: the names of all that are alike, and the index of the first of them."""
    kinds = likeness(plan).kinds
    names: dict[int, list[str]] = {}
    for one in plan.formation:
        names.setdefault(kinds[one.index], []).append(one.name)
    groups = [node.index for node in plan.nodes if node.parent is not None]
    seen = set()
    for kind, members in (("group", groups), ("robot", [robot.index for robot in plan.robots])):
        for member in members:
            if kinds[member] not in seen:
                seen.add(kinds[member])
                yield ("group" if kind == "group" else "robot"), tuple(names[kinds[member]]), member


def _layer(plan: Plan, link: LinkPlan | tuple[int, int, Channel]) -> str:
    """Returns the layer of a link."""
    source, receiver, _ = link if isinstance(link, tuple) else edge_of(link)
    node = max(source, receiver)  # children before parents
    return plan.block_of(node).layer if node < len(plan.formation) else "robot"
