"""HELICS with the ipc core: publications and inputs; each level of the tree runs one time step after the one before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

try:
    import helics
except ImportError:  # reported by the caller
    pass

from bench.tree import (
    COORDINATOR,
    LEADERS,
    ROBOTS,
    ROLES,
    BlockingPorts,
    Meter,
    Role,
    die_with_parent,
    play,
    run_processes,
)

REQUIRES = ("helics",)
_STEPS = 4  # steps of HELICS time in a tick: state, group state, reference, command
_OFFSET = {"state": 1, "group": 2, "reference": 3, "command": 4}


class _Federate(BlockingPorts):
    def __init__(self, federate: Any, publications: dict[str, Any], inputs: dict[str, list[Any]]) -> None:
        self._federate, self._publications, self._inputs = federate, publications, inputs
        self._request, self._publish = helics.helicsFederateRequestTime, helics.helicsPublicationPublishBytes
        self._get = helics.helicsInputGetBytes
        self._ticks = dict.fromkeys(_OFFSET, 0)

    def send(self, channel: str, payload: bytes) -> None:
        self._publish(self._publications[channel], payload)

    def receive(self, channel: str) -> list[bytes]:
        wanted = float(self._ticks[channel] * _STEPS + _OFFSET[channel])
        self._ticks[channel] += 1
        granted = self._request(self._federate, wanted)
        assert granted == wanted, (granted, wanted)
        return [bytes(self._get(one)) for one in self._inputs[channel]]


def _broker(name: str, folder: Path) -> None:
    die_with_parent()

    broker = helics.helicsCreateBroker("ipc", name, f"-f {len(ROLES)} --local_interface={name} --loglevel=error")
    meter = Meter()
    meter.start()
    helics.helicsBrokerWaitForDisconnect(broker, -1)
    meter.report(folder, "broker", None)
    helics.helicsCloseLibrary()


def _federate(name: str, role: Role, ticks: int, folder: Path) -> None:
    die_with_parent()

    info = helics.helicsCreateFederateInfo()
    helics.helicsFederateInfoSetCoreTypeFromString(info, "ipc")
    helics.helicsFederateInfoSetCoreInitString(info, f"--broker_address={name} --federates=1 --loglevel=error")
    helics.helicsFederateInfoSetTimeProperty(info, helics.HELICS_PROPERTY_TIME_DELTA, 1.0)
    # a role waits for all of its inputs in one request; without this flag each value that comes before wakes it
    helics.helicsFederateInfoSetFlagOption(info, helics.HELICS_FLAG_UNINTERRUPTIBLE, True)
    federate = helics.helicsCreateValueFederate(f"{name}{role.name}", info)
    sends, receives = _channels(role)
    publications = {
        channel: helics.helicsFederateRegisterGlobalPublication(
            federate, f"{role.name}/{channel}", helics.HELICS_DATA_TYPE_RAW, ""
        )
        for channel in sends
    }
    inputs = {
        channel: [helics.helicsFederateRegisterSubscription(federate, f"{one.name}/{channel}", "") for one in sources]
        for channel, sources in receives.items()
    }
    helics.helicsFederateEnterExecutingMode(federate)
    meter = Meter()
    meter.start()
    ports = _Federate(federate, publications, inputs)
    value = ports.drive(play(role, ports.send, ticks))
    meter.report(folder, role.name, value)
    helics.helicsFederateDisconnect(federate)
    helics.helicsFederateFree(federate)
    helics.helicsCloseLibrary()


def _channels(role: Role) -> tuple[list[str], dict[str, list[Role]]]:
    if role.number is not None:
        return ["state"], {"command": [Role(role.group)]}
    if role.group is not None:
        robots = [Role(role.group, number) for number in range(ROBOTS)]
        return ["group", "command"], {"state": robots, "reference": [COORDINATOR]}
    return ["reference"], {"group": list(LEADERS)}


def run(ticks: int, folder: Path) -> None:
    """Runs the exchange, with a further process for the broker."""
    import multiprocessing

    context = multiprocessing.get_context("fork")
    name = folder.name.replace("-", "")
    children = [context.Process(target=_broker, args=(name, folder), daemon=True)]
    children += [context.Process(target=_federate, args=(name, role, ticks, folder), daemon=True) for role in ROLES]
    run_processes(children)
