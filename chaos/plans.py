"""Chaos plans: what is done to one run, drawn from a seed.  Pure: the same seed gives the same plan.

A plan is a run (its clock, its torque path, its formation) and one to three hits on it.  Hits on a *target* are for a process,
by its name in the run, for the `supervisor` (the command itself), or for the whole `group` of processes.
"""

import random
from dataclasses import dataclass
from typing import Final, Literal

FOREVER: Final = float("inf")
Clock = Literal["virtual", "wall"]
Path = Literal["mirror", "closed"]
Origin = Literal["here", "elsewhere"]

KINDS: Final = (
    "kill",
    "freeze",
    "signal",
    "flood_bus",
    "forge_bus",
    "malformed_bus",
    "flood_zenoh",
    "forge_zenoh",
    "full_disk",
    "no_reader",
)
"""All kinds of hits"""
TRAFFIC: Final = ("flood_bus", "forge_bus", "malformed_bus", "flood_zenoh", "forge_zenoh")
"""Kinds of hits that only send something to the run"""
FREEZES_S: Final = (0.2, 2.0, 20.0, FOREVER)
SIGNALS: Final = ("TERM", "INT", "HUP")
ORIGINS: Final[tuple[Origin, ...]] = ("here", "elsewhere")
GROUPS: Final = ("north", "south")


@dataclass(frozen=True, slots=True)
class Hit:
    """One thing that is done to a run."""

    kind: str
    """One of `KINDS`"""
    at_s: float
    """When: after the first frame with torque was heard [s]; if negative, after the start of the command"""
    target: str = ""
    """The process that is hit; "" for traffic, disk and output"""
    lasts_s: float = 0.0
    """How long a target is frozen, or traffic is sent [s]"""
    signal: str = ""
    """Of a `signal`: its name without SIG"""
    origin: Origin = "here"
    """Of traffic on the bus: from this host, or from another one, which is another network namespace"""
    secret: Literal["none", "observer"] = "none"
    """Of traffic over Zenoh: whether the sender has the secret of an observer"""
    room: int = 0
    """Of `full_disk`: how much the disk holds [bytes]; of `no_reader`: 0 if standard output is closed, 1 if it is full"""

    def __str__(self) -> str:
        when = f"{self.at_s:.2f} s" if self.at_s >= 0 else f"{-self.at_s:.2f} s after the start"
        lasts = "for ever" if self.lasts_s == FOREVER else f"for {self.lasts_s:g} s"
        match self.kind:
            case "kill":
                return f"kill -9 {self.target} at {when}"
            case "freeze":
                return f"freeze {self.target} {lasts} at {when}"
            case "signal":
                return f"SIG{self.signal} to {self.target} at {when}"
            case "full_disk":
                return f"a disk of {self.room // 1024} kB"
            case "no_reader":
                return "standard output full" if self.room else "standard output closed"
            case "flood_zenoh" | "forge_zenoh":
                secret = "without a secret" if self.secret == "none" else "with an observer's secret"
                return f"{self.kind} {secret} {lasts} at {when}"
        return f"{self.kind} from {self.origin} {lasts} at {when}"


@dataclass(frozen=True, slots=True)
class ChaosPlan:
    """A run and what is done to it."""

    seed: int
    clock: Clock
    path: Path
    robots: int
    """Number of robots, 3 to 5; the first three are in the group north, the others in the group south"""
    duration_s: float
    """Length of the run in run time [s]"""
    hits: tuple[Hit, ...]
    report: bool = False
    """True: the run writes a report"""

    @property
    def observed(self) -> bool:
        """True: the run is open to observers."""
        return any(hit.kind in ("forge_zenoh", "flood_zenoh") for hit in self.hits)

    @property
    def needs_room(self) -> bool:
        """True: the plan needs namespaces of its own, for another host or for a small disk."""
        return any(hit.origin == "elsewhere" or hit.kind == "full_disk" for hit in self.hits)

    def __str__(self) -> str:
        hits = "; ".join(map(str, self.hits))
        return f"seed {self.seed}: {self.clock} clock, {self.path} path, {self.robots} robots, {self.duration_s:g} s: {hits}"


def robot_names(robots: int) -> tuple[str, ...]:
    """Returns the names of the robots of a run, in the order of the plan and of their frames."""
    return tuple(f"north/n{number}" if number <= 3 else f"south/s{number}" for number in range(1, robots + 1))


def group_names(robots: int) -> tuple[str, ...]:
    """Returns the names of the groups of a run."""
    return GROUPS if robots > 3 else GROUPS[:1]


def members(path: Path, robots: int) -> tuple[str, ...]:
    """Returns the names of all processes of a run but the supervisor."""
    watchers = ("bridge", "recorder", "drives") if path == "closed" else ("bridge", "recorder")
    return (*robot_names(robots), *group_names(robots), "coordinator", *watchers)


def draw(seed: int, kinds: tuple[str, ...] = KINDS, *, short: bool = False) -> ChaosPlan:
    """Returns the plan of a seed with hits of these kinds.  `short`: one hit only, and none that lasts for long."""
    chance = random.Random(f"chaos {seed}")
    clock: Clock = chance.choice(("virtual", "wall"))
    path: Path = chance.choice(("mirror", "closed"))
    robots = chance.choice((3, 4, 5))
    duration_s = 2.5 if clock == "wall" else 8.0
    count = 1 if short else chance.choice((1, 1, 1, 2, 2, 3))
    hits: list[Hit] = []
    while len(hits) < count:
        hit = _draw_hit(chance, chance.choice(kinds), clock, path, robots, short)
        if all((hit.kind, hit.target) != (other.kind, other.target) for other in hits):
            hits.append(hit)
    return ChaosPlan(
        seed, clock, path, robots, duration_s, tuple(sorted(hits, key=lambda hit: hit.at_s)), chance.random() < 0.2
    )


def _draw_hit(chance: random.Random, kind: str, clock: Clock, path: Path, robots: int, short: bool) -> Hit:
    """Returns a hit of a kind, at a time at which most runs still go on."""
    at_s = chance.uniform(0.05, 1.8 if clock == "wall" else 0.5)
    if not short and chance.random() < 0.15:
        at_s = -chance.uniform(0.05, 3.0)
    target = chance.choice((*members(path, robots), "bridge", "supervisor"))
    lasts_s = chance.choice(FREEZES_S[:2] if short else FREEZES_S)
    signal, origin = chance.choice(SIGNALS), chance.choice(ORIGINS)
    match kind:
        case "kill":
            return Hit(kind, at_s, target)
        case "freeze":
            return Hit(kind, at_s, target, lasts_s)
        case "signal":
            return Hit(kind, at_s, chance.choice((target, "supervisor", "group", "group")), signal=signal)
        case "flood_bus" | "forge_bus" | "malformed_bus":
            return Hit(kind, at_s, lasts_s=chance.choice((0.1, 0.5, 1.0)), origin=origin)
        case "flood_zenoh":
            return Hit(kind, at_s, lasts_s=chance.choice((0.2, 1.0)))
        case "forge_zenoh":
            secret: Literal["none", "observer"] = chance.choice(("none", "observer"))
            return Hit(kind, at_s, lasts_s=0.5, secret=secret)
        case "full_disk":
            return Hit(kind, at_s, room=chance.choice((16, 64, 128, 256, 512, 1024)) * 1024)
        case "no_reader":
            return Hit(kind, at_s, room=chance.choice((0, 1)))
    raise ValueError(f"unknown kind of hit {kind!r}; known: {', '.join(KINDS)}")
