"""Chooses the node id of each drive on its bus, so that no two drives use the same identifier.

On each bus identifiers are assigned in this order:

1. those that all drives of a protocol share, for every protocol on the bus;
2. those of protocols in which a robot's number is its node id;
3. those of node ids that the scenario gives;
4. for all other drives, those of the lowest node ids that are free.  Drives whose identifiers lie furthest apart choose first,
   because they have the least choice: a node of one protocol has 32 identifiers in a row, a node of another protocol has
   twelve, each in another place.

Node id 0 is never chosen, because new drives have it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from echelon.plan.can_plan import Addressing
from echelon.plan.plan import PlanError
from echelon.plugins import PART_ERRORS, Part

MAX_IDENTIFIER: Final = 0x7FF
SHOWN: Final = 8
"""Number of free node ids that an error lists."""


@dataclass(frozen=True, slots=True)
class Place:
    """The drives of one robot that need node ids."""

    key: str
    """Key of the robot's drive in the scenario"""
    path: str
    """Path of the robot in the tree"""
    robot: int
    """Index of the robot"""
    bus: int
    """Number of the bus"""
    protocol: Part[Any]
    """Protocol of the drives"""
    given: tuple[int, int] | None
    """Node ids that the scenario gives, of the right and the left wheel's drive"""

    @property
    def addressing(self) -> Addressing:
        """The protocol's object, with the interface that planning uses."""
        made: Addressing = self.protocol.made
        return made


def ask(part: Part[Any], key: str, method: str, *arguments: Any) -> Any:
    """Calls a method of a protocol and returns its answer.  Raises PlanError if the method raises, as a user's protocol may."""
    try:
        return getattr(part.made, method)(*arguments)
    except PART_ERRORS as error:
        raise PlanError(f"{key}.protocol: {part.raised('', method, error)}") from None


def choose_nodes(places: Sequence[Place]) -> dict[int, tuple[int, int]]:
    """Returns the node ids of the right and the left wheel's drive, by the robot's index.  Raises PlanError if they collide, or
    too few are free."""
    chosen: dict[int, tuple[int, int]] = {}
    for bus in sorted({place.bus for place in places}):
        chosen |= _Bus([place for place in places if place.bus == bus]).choose()
    return chosen


class _Bus:
    """One bus and the users of its identifiers."""

    def __init__(self, places: Sequence[Place]) -> None:
        self._places = places
        self._users: dict[int, str] = {}
        """Who uses an identifier, in words, by the identifier"""
        self._known: dict[tuple[int, int], frozenset[int]] = {}
        """Identifiers that a protocol has told, by protocol and node id"""

    def choose(self) -> dict[int, tuple[int, int]]:
        """Returns the node ids of all drives on the bus, by the robot's index.  Raises PlanError."""
        first_of = {place.protocol.use: place for place in reversed(self._places)}
        for use, place in first_of.items():
            shared = _checked(ask(place.protocol, place.key, "shared_identifiers"), place)
            if found := self._take(shared, f"what all drives of {use} share"):
                raise PlanError(f"{_collision(place, found)}; give another bus")
        numbered = [place for place in self._places if place.addressing.by_number]
        given = [place for place in self._places if not place.addressing.by_number and place.given is not None]
        waiting = [place for place in self._places if not place.addressing.by_number and place.given is None]
        return self._by_number(numbered) | self._given(given) | self._lowest(waiting)

    def _by_number(self, places: Sequence[Place]) -> dict[int, tuple[int, int]]:
        """Assigns robots' numbers as node ids.  Raises PlanError."""
        for place in places:
            use, nodes = place.protocol.use, place.addressing.nodes
            if place.given is not None:
                raise PlanError(f"{place.key}.node_ids: not for {use}, which goes by the robot's number")
            if place.robot not in nodes:
                raise PlanError(f"{place.key}.protocol = {use!r}: has no place for robot number {place.robot}")
            if found := self._take(self._identifiers(place, place.robot), f"those of {place.path}"):
                raise PlanError(f"{_collision(place, found)}; {self._same(place) or 'give another bus'}")
        return {place.robot: (place.robot, place.robot) for place in places}

    def _given(self, places: Sequence[Place]) -> dict[int, tuple[int, int]]:
        collisions: list[tuple[Place, tuple[int, str]]] = []
        chosen = {}
        for place in places:
            assert place.given is not None
            nodes = set(place.given)
            if len(nodes) != len(place.addressing.wheels) or not all(node in place.addressing.nodes for node in nodes):
                raise PlanError(
                    f"{place.key}.node_ids = {list(place.given)}: {_needed(place)} for {place.protocol.use}"
                )
            chosen[place.robot] = place.given
            for node in sorted(nodes):
                if found := self._take(self._identifiers(place, node), f"those of {place.path}"):
                    collisions.append((place, found))
        for place, found in collisions:  # reported last: only now is it known which node ids are free
            self._users = {can_id: user for can_id, user in self._users.items() if user != f"those of {place.path}"}
            free = self._free(place)
            more = ", …" if len(free) > SHOWN else ""
            shown = f"free are {', '.join(map(str, free[:SHOWN]))}{more}" if free else "none is free"
            more = self._same(place) or f"{shown}; or give another bus"
            raise PlanError(f"{_collision(place, found)}; {more}")
        return chosen

    def _lowest(self, places: Sequence[Place]) -> dict[int, tuple[int, int]]:
        """Assigns the lowest free node ids.  Raises PlanError if too few are free."""
        chosen = {}
        for place in sorted(places, key=self._spread, reverse=True):
            nodes = []
            for _ in place.addressing.wheels:
                if not (free := self._free(place)):
                    more = self._same(place) or "put some robots on another bus (can.buses)"
                    raise PlanError(f"{place.key}: no node id is free for a drive of {place.protocol.use}; {more}")
                nodes.append(free[0])
                self._take(self._identifiers(place, free[0]), f"those of {place.path}")
            chosen[place.robot] = nodes[0], nodes[-1]
        return chosen

    def _identifiers(self, place: Place, node: int) -> frozenset[int]:
        """Returns the identifiers that a node id takes.  Raises PlanError if the protocol's answer is wrong."""
        key = id(place.protocol), node
        if key not in self._known:
            self._known[key] = _checked(ask(place.protocol, place.key, "identifiers", node), place)
        return self._known[key]

    def _take(self, identifiers: frozenset[int], who: str) -> tuple[int, str] | None:
        """Notes the user of identifiers.  Returns the lowest identifier that has a user already, with that user, or None."""
        twice = min((can_id for can_id in identifiers if can_id in self._users), default=None)
        other = None if twice is None else (twice, self._users[twice])
        self._users = dict.fromkeys(identifiers, who) | self._users
        return other

    def _free(self, place: Place) -> list[int]:
        """Returns the node ids whose identifiers are all free, in ascending order."""
        nodes = (node for node in place.addressing.nodes if node)
        return [node for node in nodes if self._users.keys().isdisjoint(self._identifiers(place, node))]

    def _same(self, place: Place) -> str:
        """Returns a text about the identifier that a protocol names for every node id; "" if there is none."""
        nodes = place.addressing.nodes
        same = frozenset.intersection(*(self._identifiers(place, node) for node in nodes))
        if not same or len(nodes) < 2:
            return ""
        return f"its identifiers(node) names {min(same):#05x} for every node; each node needs its own"

    def _spread(self, place: Place) -> int:
        """Returns the difference between the largest and the smallest identifier of a node."""
        one = self._identifiers(place, place.addressing.nodes[-1])
        return max(one, default=0) - min(one, default=0)


def _checked(answer: Any, place: Place) -> frozenset[int]:
    """Returns a protocol's answer if it is a set of identifiers.  Raises PlanError for anything else."""
    if not (
        isinstance(answer, (set, frozenset))
        and all(type(can_id) is int and 0 <= can_id <= MAX_IDENTIFIER for can_id in answer)
    ):
        raise PlanError(
            f"{place.key}.protocol: {place.protocol.use}: identifiers must be a set of numbers from 0 to "
            f"{MAX_IDENTIFIER:#x}, not {answer!r:.60}"
        )
    return frozenset(answer)


def _collision(place: Place, found: tuple[int, str]) -> str:
    """Returns the text about an identifier of `place` that has another user (`found`)."""
    can_id, who = found
    where = "" if place.given is None else f".node_ids = {list(place.given)}"
    return f"{place.key}{where}: identifier {can_id:#05x} of {place.path} collides with {who}"


def _needed(place: Place) -> str:
    """Returns the text about how many node ids a robot's drives need, and from which range."""
    nodes = place.addressing.nodes
    if len(place.addressing.wheels) == 1:
        return f"one from {nodes[0]} to {nodes[-1]}, written twice, is needed"
    return f"two different ones from {nodes[0]} to {nodes[-1]} are needed"
