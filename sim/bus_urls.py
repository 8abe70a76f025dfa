"""Chooses the URL of each bus of a run: from `--can`, else from the scenario; and checks it against this machine."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Final

from echelon.bridge.can.bus_url import free_multicast_url, interface_is_up, resolve_url, why_no_multicast
from echelon.bridge.can.claim import DRIVES, HOST, BusTakenError, Claim, is_claimed
from echelon.bridge.can.link_kind import is_hardware
from echelon.errors import UsageError
from echelon.plan.can_plan import DISTURBANCES
from echelon.plan.plan import Plan

NO_MULTICAST: Final = "multicast cannot be used here"
ADVICE: Final = "sudo ip link set lo multicast on; sudo ip route add 224.0.0.0/4 dev lo"


def bus_urls(plan: Plan, wanted: str | None, one_process: bool) -> tuple[str, ...]:
    """Returns the full URL of each bus of the plan, in its order; empty if the run makes no frames.

    If nobody named a bus, and this machine has none that several processes could share, a run whose frames only mirror torques
    makes none.

    `wanted` is the value of `--can`: one URL for all buses, or one for each with commas between; `none`: no frames; None: what
    the scenario says.  `one_process` says that all roles run in one process.  Raises UsageError if the number of URLs does not
    fit, two buses have the same URL, a URL is not known, a network interface is not there, or a closed path has no bus."""
    if wanted == "none" or not (plan.can.enabled or wanted):
        return ()
    urls = [bus.url for bus in plan.can.buses]
    if wanted:
        given = wanted.split(",")
        if len(given) not in (1, len(urls)):
            names = ", ".join(bus.name for bus in plan.can.buses)
            raise UsageError(f"--can {wanted}: must be one URL, or one for each bus ({names}) with commas between")
        urls = given * len(urls) if len(given) == 1 else given
    if one_process:  # it needs no bus that others can use, unless `wanted` or the scenario names one
        urls = [f"virtual:{bus.name}" if url == "auto" else url for url, bus in zip(urls, plan.can.buses, strict=True)]
    resolved = tuple(_checked_bus(url, number) for number, url in enumerate(urls))
    by_default = [chosen for url, chosen in zip(urls, resolved, strict=True) if url == "auto"]
    if wanted is None and any(url.startswith("udp_multicast") for url in by_default) and (why := why_no_multicast()):
        if plan.can.closed:
            raise UsageError(
                f"the closed torque path needs a bus: no vcan0 is up, and {NO_MULTICAST}: {why} ({ADVICE})"
            )
        return ()
    if len(set(resolved)) < len(resolved):
        raise UsageError(f"--can {wanted or ','.join(urls)}: two buses have the same URL")
    return resolved


def check_wall_clock(plan: Plan, urls: Sequence[str]) -> None:
    """Raises UsageError if the plan cannot run on a wall clock on buses with these URLs."""
    disturbed = sorted({event.kind for event in plan.events} & set(DISTURBANCES))
    if disturbed and not plan.can.paced:
        raise UsageError(
            f"events of kind {disturbed[0]!r}: on a wall clock a bus takes its own time, so its errors cannot be scheduled"
            + ("; with --set can.timing=bits a virtual bus is as slow as a real one" if plan.can.virtual_drives else "")
        )
    real = [url for url in urls if is_hardware(url)]
    if plan.can.paced and real:
        raise UsageError(
            f"can.timing = 'bits': {real[0]} is a real bus, which takes its own time; leave can.timing out"
        )


def _checked_bus(url: str, number: int) -> str:
    """Returns the full URL of the bus with this number.  Raises UsageError if it is not known or not on this machine."""
    try:
        resolved = resolve_url(url, number)
    except ValueError as error:
        raise UsageError(f"--can {url}: {error}") from None
    kind, _, name = resolved.partition(":")
    if kind == "socketcan" and not interface_is_up(name):
        raise UsageError(f"--can {url}: there is no network interface {name} that is up")
    if url == "auto" and any(is_claimed(resolved, side) for side in (HOST, DRIVES)):
        return free_multicast_url()
    return resolved


@contextmanager
def claimed(urls: Sequence[str], *sides: str) -> Iterator[None]:
    """Claims sides of the buses at these URLs.  Raises UsageError if another run has one of them."""
    with ExitStack() as stack:
        for url in urls:
            for side in sides:
                try:
                    stack.enter_context(Claim(url, side))
                except BusTakenError as taken:
                    raise UsageError(f"{url}: {taken}; give another port or interface with --can") from None
        yield


def sides_of(plan: Plan) -> tuple[str, ...]:
    """Returns the sides of its buses that a run of this plan needs for itself."""
    return (HOST, DRIVES) if plan.can.closed and plan.can.virtual_drives else (HOST,)
