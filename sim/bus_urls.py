"""Where the buses of a run are: what the scenario says, what --can says, and what this machine has."""

from collections.abc import Sequence
from pathlib import Path

from echelon.bridge.can.bus_url import interface_is_up, resolve_url
from echelon.errors import UsageError
from echelon.plan.can_plan import DISTURBANCES
from echelon.plan.plan import Plan


def bus_urls(plan: Plan, wanted: str | None, one_process: bool) -> tuple[str, ...]:
    """Returns where each of the plan's buses is, in full; none if there are to be no frames.  Raises UsageError.

    `wanted` is what --can says: a URL for all buses, or one for each, with commas between."""
    if wanted == "none" or not (plan.can.enabled or wanted):
        return ()
    urls = [bus.url for bus in plan.can.buses]
    if wanted:
        given = wanted.split(",")
        if len(given) not in (1, len(urls)):
            raise UsageError(f"--can {wanted}: {len(given)} of them for {len(urls)} buses")
        urls = given * len(urls) if len(given) == 1 else given
    if one_process:  # it needs no bus to others; name one to be heard
        urls = [f"virtual:{bus.name}" if url == "auto" else url for url, bus in zip(urls, plan.can.buses, strict=True)]
    resolved = tuple(_checked_bus(url, number) for number, url in enumerate(urls))
    if len(set(resolved)) < len(resolved):
        raise UsageError(f"--can {wanted or ','.join(urls)}: {len(resolved)} buses need as many places")
    return resolved


def check_wall_clock(plan: Plan, urls: Sequence[str]) -> None:
    """Raises UsageError for what cannot be on a wall clock, with the buses at these places."""
    disturbed = sorted({event.kind for event in plan.events} & set(DISTURBANCES))
    if disturbed and not plan.can.paced:
        raise UsageError(
            f"events of kind {disturbed[0]!r}: on a wall clock a bus takes its own time, and errors as they come"
            + ("; --set can.timing=bits makes a virtual one as slow as a real one" if plan.can.virtual_drives else "")
        )
    real = [url for url in urls if (Path("/sys/class/net") / url.partition(":")[2] / "device").exists()]
    if plan.can.paced and real:
        raise UsageError(f"can.timing = 'bits': {real[0]} is a real bus on a wall clock, and takes its own time")


def _checked_bus(url: str, number: int = 0) -> str:
    try:
        resolved = resolve_url(url, number)
    except ValueError as error:
        raise UsageError(f"--can {url}: {error}") from None
    kind, _, name = resolved.partition(":")
    if kind == "socketcan" and not interface_is_up(name):
        raise UsageError(f"--can {url}: there is no network interface {name} that is up")
    return resolved
