"""The latencies of a run on a wall clock, and a scenario whose links have them: virtual time with it is that run again."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import tomlkit

from echelon.errors import UsageError, UserError
from echelon.files import write_text
from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.delay_tables import LOST
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.planning.delays import LOST_WORD
from echelon.runtime.arrivals import FILE
from echelon.scenario.tables import Scenario
from echelon.shipped import EFFECTIVE
from echelon.sim.kept_parts import keep_parts
from echelon.sim.out_folder import RECORDING
from echelon.sim.parts.loading import load, parse
from echelon.sim.recording.arrivals import read_arrivals
from echelon.sim.recording.mcap_reader import read_metadata
from echelon.sim.results.arrivals import Arrivals
from echelon.sim.results.latencies import Latencies


def measured(folder: Path) -> Latencies:
    """Returns the latencies of the run in a folder.  Raises UserError if there are none, or files cannot be read."""
    path = folder / RECORDING
    try:
        metadata = read_metadata(path)
        if metadata.get("clock") != "wall":
            raise UsageError(
                f"{folder}: a run in virtual time; its latencies are those that its scenario gives the links "
                "(`links` in summary.json)"
            )
        if metadata.get("engine") == "inprocess":
            raise UsageError(f"{folder}: a run in one process; messages take no time there")
        if not (folder / FILE).exists():
            raise UserError(f"{folder / FILE}: not there; the run did not note when messages arrived")
        _, plan = load(folder / EFFECTIVE, trial=False)
        arrivals = read_arrivals(folder / FILE, plan)
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    except ValueError as error:  # its text begins with the name of the file
        raise UserError(str(error)) from None
    if not any(len(one.numbers) for one in arrivals.links.values()):
        raise UserError(f"{folder / FILE}: holds no arrivals")
    return Latencies.of(str(folder), arrivals)


def write_traces(run: Path, arrivals: Arrivals, out: Path, *, replace: bool = False) -> list[Path]:
    """Writes a trace of delays for each link of a run that can have a rule, and a scenario whose links take them; returns the
    files, the scenario first.

    The folder `out` is made if it does not exist.  Files with the same content stay.  Raises UsageError if another file is in
    the way, unless `replace`, UserError if the run's scenario cannot be read, and OSError."""
    scenario, plan = load(run / EFFECTIVE, trial=False)
    traces = {number: trace_name(plan, link) for number, link in _can_have_rules(plan, arrivals)}
    texts = {name: trace_text(plan, arrivals, number) for number, name in traces.items()}
    out.mkdir(parents=True, exist_ok=True)
    without_links = scenario.model_copy(update={"links": []})
    kept = keep_parts(scenario if plan.can.closed else without_links, out, (EFFECTIVE, *texts))
    table = _with_traces(scenario, plan, traces, kept.names)
    texts = {EFFECTIVE: tomlkit.dumps(table), **texts}
    for name, text in texts.items():
        if os.path.lexists(out / name) and not replace and _content(out / name) != text:
            raise UsageError(f"{out / name}: exists with other content; give another folder with --out, or --replace")
    for name, text in texts.items():
        write_text(out / name, text)
    parse(texts[EFFECTIVE], str(out / EFFECTIVE), folder=out, trial=False)
    return [out / name for name in texts]


def trace_name(plan: Plan, link: LinkPlan) -> str:
    """Returns the name of the file for a link: `g1.r1-g1-state.csv`."""
    source, receiver = (plan.all_roles[end].name.replace("/", ".") for end in (link.source, link.receiver))
    return f"{source}-{receiver}-{link.channel.name.lower()}.csv"


def trace_text(plan: Plan, arrivals: Arrivals, number: int) -> str:
    """Returns the delays of a link as a trace file has them, one for each message of the run."""
    link = plan.links[number]
    source, receiver = (plan.all_roles[end].name for end in (link.source, link.receiver))
    lines = [f"# one-way delays [s]: {source} to {receiver}, {link.channel.name.lower()}, message by message", "delay"]
    delays = arrivals.trace(number).delays_ns
    lines += [LOST_WORD if each == LOST else f"{each // 10**9}.{each % 10**9:09d}" for each in delays]
    return "\n".join(lines) + "\n"


def _can_have_rules(plan: Plan, arrivals: Arrivals) -> Iterator[tuple[int, LinkPlan]]:
    """Yields the links with arrivals that a rule can be about: all but those that stand for shafts."""
    for number in arrivals.links:
        if plan.links[number].channel is not Channel.WHEELS:
            yield number, plan.links[number]


def _with_traces(scenario: Scenario, plan: Plan, traces: Mapping[int, str], names: Mapping[Any, str]) -> dict[str, Any]:
    """Returns a scenario as a table of TOML, with a rule for each link that has a trace.

    What a rule says about lateness stays: policy and timeout.  Rules of other links stay as they are.  Blackouts of the links
    with traces go: the traces have what they lost."""
    table: dict[str, Any] = scenario.model_dump(mode="json", exclude_none=True, context=names)
    members = plan.all_roles
    rules = []
    for number, name in traces.items():
        link = plan.links[number]
        rule: dict[str, Any] = {
            "source": members[link.source].name,
            "receiver": members[link.receiver].name,
            "channel": link.channel.name.lower(),
            "delay": {"kind": "trace", "file": name},
            "policy": link.policy,
        }
        if link.timeout_ns < NEVER_NS:
            rule["timeout"] = link.timeout_ns / 1e9
        rules.append(rule)
    named = {link.name for number, link in enumerate(plan.links) if number not in traces}
    table["links"] = [*(table.get("links", ()) if plan.can.closed else ()), *rules]
    if "events" in table:
        table["events"] = [each for each in table["events"] if each.get("link") is None or each["link"] in named]
    return table


def _content(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None
