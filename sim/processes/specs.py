"""The list of a run's processes: what each does, to whom it connects, and with which secrets."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from echelon.plan.plan import Plan, RobotPlan
from echelon.runtime.credentials import Credentials, Identity, new_identity
from echelon.runtime.session import loopback_endpoints
from echelon.runtime.wire import data_key, run_keys, token_key, watch_key
from echelon.sim.observing import Gate
from echelon.sim.processes.contract import FINISHING, ProcessSpec
from echelon.sim.processes.ends_at import EndsAt

NOBODY: Final = Credentials(Identity("", "", "", ()))
"""Credentials before `introduced` has made them"""


def list_specs(
    plan: Plan,
    run: str,
    virtual: bool,
    folder: Path,
    can_urls: tuple[str, ...],
    scenario_toml: str,
    metadata: dict[str, str],
    part_files: dict[str, str],
    recorded: bool,
    ends_at: EndsAt,
    gate: Gate | None = None,
    every_ns: int = 0,
) -> list[ProcessSpec]:
    """Returns the specifications of all processes of a run, with their connections.

    process        who connects to it
    node           its children
    recorder       all other processes except observers and referee
    observers      the same, if the run is open to observers
    bridge         robots
    drives         robots and the bridge

    Real drives have no process.  The referee connects to no process; it listens to the buses.
    """
    mirrored = bool(can_urls) and not plan.can.closed
    stations = ["bridge"] if mirrored else [role.name for role in plan.bus_roles]
    watchers = (["recorder"] if recorded else []) + (["observers"] if gate is not None else [])
    # a mirroring bridge and observers need the copies of all messages; then only the recorder leaves some out
    members_ns = every_ns if watchers == ["recorder"] and not mirrored else 0
    hubs = watchers + stations
    endpoints = loopback_endpoints(len(plan.nodes) + len(hubs))
    at = {node.index: endpoints.pop() for node in plan.nodes}
    hub_at = {hub: endpoints.pop() for hub in hubs}
    common: dict[str, Any] = {
        "run": run,
        "plan": plan,
        "virtual": virtual,
        "recorded": recorded,
        "folder": str(folder),
        "can_urls": can_urls,
        "scenario_toml": scenario_toml,
        "metadata": metadata,
        "part_files": part_files,
        "ends_at": ends_at,
        "every_ns": every_ns,
        "credentials": NOBODY,
    }

    def with_hubs(names: Iterable[str]) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
        return tuple(hub_at[name] for name in names), tuple((name, name) for name in names)

    specs = []
    for member in plan.formation:
        near = [] if member.parent is None else [member.parent]
        near += [] if isinstance(member, RobotPlan) else member.children
        endpoints_of, peers_of = with_hubs(watchers + (stations if isinstance(member, RobotPlan) else []))
        specs.append(
            ProcessSpec(
                kind=member.role,
                name=member.name,
                index=member.index,
                listen=(at[member.index],) if member.index in at else (),
                connect=(*(() if member.parent is None else (at[member.parent],)), *endpoints_of),
                peers=(*((plan.formation[peer].role, plan.formation[peer].name) for peer in near), *peers_of),
                watched=bool(watchers) or (mirrored and isinstance(member, RobotPlan)),
                **(common | {"every_ns": members_ns}),
            )
        )
    robots = tuple((robot.role, robot.name) for robot in plan.robots)
    for number, station in enumerate(stations):
        later = stations[number + 1 :]
        endpoints_of, _ = with_hubs(watchers + later)
        others = tuple((name, name) for name in watchers + stations if name != station)
        specs.append(
            ProcessSpec(
                kind=station,
                name=station,
                index=len(plan.formation) + number,
                listen=(hub_at[station],),
                connect=endpoints_of,
                peers=(*robots, *others),
                watched=bool(watchers),
                member=virtual and plan.can.closed,
                **common,
            )
        )
    for number, watcher in enumerate(watchers):
        everyone = tuple((member.role, member.name) for member in plan.formation)
        specs.append(
            ProcessSpec(
                kind=watcher,
                name=watcher,
                index=len(plan.formation) + len(stations) + number,
                listen=(hub_at[watcher],),
                connect=(),
                peers=(*everyone, *((name, name) for name in stations)),
                member=False,
                gate=gate if watcher == "observers" else None,
                **common,
            )
        )
    if not virtual and any(not url.startswith("virtual") for url in can_urls):
        specs.append(
            ProcessSpec(
                kind="referee", name="referee", index=-1, listen=(), connect=(), peers=(), member=False, **common
            )
        )
    # the processes with the most imports start first
    return sorted(introduced(specs), key=lambda spec: spec.kind not in FINISHING)


def introduced(specs: Sequence[ProcessSpec]) -> list[ProcessSpec]:
    """Returns the specifications with new credentials: each process knows those that it is connected to, and nobody else."""
    own = [new_identity(f"{spec.kind}/{spec.name}", _own_keys(spec)) for spec in specs]
    at = {endpoint: one for spec, one in zip(specs, own, strict=True) for endpoint in spec.listen}
    guests: dict[str, list[Identity]] = {}
    for spec, one in zip(specs, own, strict=True):
        for endpoint in spec.connect:
            guests.setdefault(endpoint, []).append(one)
    return [
        replace(
            spec,
            credentials=Credentials(
                one,
                run_keys(spec.run),
                guests=tuple(guest for endpoint in spec.listen for guest in guests.get(endpoint, ())),
                hosts=tuple(at[endpoint] for endpoint in spec.connect),
            ),
        )
        for spec, one in zip(specs, own, strict=True)
    ]


def _own_keys(spec: ProcessSpec) -> list[str]:
    """Returns the key expressions under which a process publishes."""
    keys = [token_key(spec.run, spec.kind, spec.name, "*"), watch_key(spec.run, spec.kind, spec.name)]
    roles = spec.plan.all_roles
    if 0 <= spec.index < len(roles):
        channels = {link.channel for link in spec.plan.links if link.source == spec.index}
        keys += [data_key(spec.run, roles[spec.index].path, channel) for channel in sorted(channels)]
    elif spec.kind == "bridge":
        keys.append(watch_key(spec.run, "bridge", "frames"))
    return keys
