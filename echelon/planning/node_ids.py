"""Node ids: which number each drive has on its bus, so that no two drives use one identifier.  Raises PlanError.

On each bus identifiers are taken in this order:

1. those that all drives of a protocol share, of every protocol on the bus;
2. those of robots whose node id is their number;
3. those of node ids that the scenario gives;
4. the rest: the lowest node ids that are free.  Drives whose identifiers lie furthest apart choose first, for they have the
   least choice: where one protocol has 32 identifiers in a row, another has one in each of twelve places.

Node 0 is never chosen: it is what a new drive has.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from echelon.plan.can_plan import Addressing
from echelon.plan.plan import PlanError
from echelon.plugins import Part

MAX_IDENTIFIER: Final = 0x7FF
SHOWN: Final = 8
"""Free node ids that a message names."""


@dataclass(frozen=True, slots=True)
class Place:
    """The drives of one robot, and the node ids that the scenario gives them, if it does."""

    key: str
    """Of the robot's drive in the scenario"""
    path: str
    robot: int
    bus: int
    protocol: Part[Any]
    given: tuple[int, int] | None

    @property
    def addressing(self) -> Addressing:
        """What planning asks of the protocol."""
        made: Addressing = self.protocol.made
        return made


def ask(part: Part[Any], key: str, method: str, *arguments: Any) -> Any:
    """Returns the answer of a protocol.  Raises PlanError if it raises: others may have written it."""
    try:
        return getattr(part.made, method)(*arguments)
    except Exception as error:
        raise PlanError(f"{key}.protocol: {part.use}: {method} raised {type(error).__name__}: {error}") from None


def choose_nodes(places: Sequence[Place]) -> dict[int, tuple[int, int]]:
    """Returns the node ids of the right and the left wheel's drive, by robot."""
    chosen: dict[int, tuple[int, int]] = {}
    for bus in sorted({place.bus for place in places}):
        chosen |= _Bus([place for place in places if place.bus == bus]).choose()
    return chosen


class _Bus:
    """One bus: who uses which of its identifiers."""

    def __init__(self, places: Sequence[Place]) -> None:
        self._places = places
        self._users: dict[int, str] = {}
        """By identifier"""
        self._known: dict[tuple[int, int], frozenset[int]] = {}

    def choose(self) -> dict[int, tuple[int, int]]:
        """Returns the node ids of all drives on the bus, by robot."""
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
        for place in places:
            use, nodes = place.protocol.use, place.addressing.nodes
            if place.given is not None:
                raise PlanError(f"{place.key}.node_ids: not for {use}, which goes by the robot's number")
            if place.robot not in nodes:
                raise PlanError(f"{place.key}.protocol = {use!r}: has no place for robot number {place.robot}")
            if found := self._take(self._identifiers(place, place.robot), f"those of {place.path}"):
                raise PlanError(f"{_collision(place, found)}; give another bus")
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
        for place, found in collisions:  # now that all that is given is known, so is what is free
            self._users = {can_id: user for can_id, user in self._users.items() if user != f"those of {place.path}"}
            free = self._free(place)
            more = ", …" if len(free) > SHOWN else ""
            shown = f"free are {', '.join(map(str, free[:SHOWN]))}{more}" if free else "none is free"
            raise PlanError(f"{_collision(place, found)}; {shown}; or give another bus")
        return chosen

    def _lowest(self, places: Sequence[Place]) -> dict[int, tuple[int, int]]:
        chosen = {}
        for place in sorted(places, key=self._spread, reverse=True):
            nodes = []
            for _ in place.addressing.wheels:
                if not (free := self._free(place)):
                    raise PlanError(
                        f"{place.key}.node_ids: {_needed(place)} for {place.protocol.use}, and no more are free; put some "
                        "robots on another bus (can.buses)"
                    )
                nodes.append(free[0])
                self._take(self._identifiers(place, free[0]), f"those of {place.path}")
            chosen[place.robot] = nodes[0], nodes[-1]
        return chosen

    def _identifiers(self, place: Place, node: int) -> frozenset[int]:
        """Returns the identifiers of a node."""
        key = id(place.protocol), node
        if key not in self._known:
            self._known[key] = _checked(ask(place.protocol, place.key, "identifiers", node), place)
        return self._known[key]

    def _take(self, identifiers: frozenset[int], who: str) -> tuple[int, str] | None:
        """Notes who uses identifiers; returns the lowest that another uses already, and who that is."""
        twice = min((can_id for can_id in identifiers if can_id in self._users), default=None)
        other = None if twice is None else (twice, self._users[twice])
        self._users = dict.fromkeys(identifiers, who) | self._users
        return other

    def _free(self, place: Place) -> list[int]:
        """Returns the node ids whose identifiers nobody uses, in ascending order."""
        nodes = (node for node in place.addressing.nodes if node)
        return [node for node in nodes if self._users.keys().isdisjoint(self._identifiers(place, node))]

    def _spread(self, place: Place) -> int:
        """Returns how far apart the identifiers of a node are."""
        one = self._identifiers(place, place.addressing.nodes[-1])
        return max(one, default=0) - min(one, default=0)


def _checked(answer: Any, place: Place) -> frozenset[int]:
    """Returns the identifiers that a protocol says it uses.  Raises PlanError for anything else."""
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
    can_id, who = found
    where = "" if place.given is None else f".node_ids = {list(place.given)}"
    return f"{place.key}{where}: identifier {can_id:#05x} of {place.path} collides with {who}"


def _needed(place: Place) -> str:
    nodes = place.addressing.nodes
    count = "one, twice," if len(place.addressing.wheels) == 1 else "two different ones"
    return f"{count} from {nodes[0]} to {nodes[-1]} are needed"
