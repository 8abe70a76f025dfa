"""Commands about scenarios: `scenarios`, `new`, `validate`, `dbc`, `schema`, and `analyse` from the module `analyse`."""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from echelon.cli.analyse import ANALYSE
from echelon.cli.options import Command, argument, option
from echelon.cli.shared import JSON, ScenarioOptions
from echelon.errors import UsageError


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenariosOptions:
    """Options of `echelon scenarios`."""

    json: bool = field(default=False, metadata=JSON)


def scenarios(options: ScenariosOptions) -> int:
    """Lists the shipped scenarios."""
    import tomllib

    from echelon.shipped import shipped

    rows = [
        {"name": name, "path": str(path), "description": tomllib.loads(path.read_text(encoding="utf-8"))["description"]}
        for name, path in shipped().items()
    ]
    if options.json:
        print(json.dumps(rows, indent=2, ensure_ascii=False))
        return 0
    width = max(len(row["name"]) for row in rows)
    for row in rows:
        print(f"{row['name']:<{width}}  {row['description']}")
    return 0


def _protocols() -> tuple[str, ...]:
    """Returns the drive protocols that are built in."""
    from echelon.bridge.protocols.registry import PROTOCOLS

    return tuple(PROTOCOLS)


@dataclass(frozen=True, slots=True, kw_only=True)
class NewOptions:
    """Options of `echelon new`."""

    name: str = field(metadata=argument("name of the scenario; NAME.toml is written into this folder", "NAME"))
    groups: str = field(
        default="2x3",
        metadata=option("number of groups x robots in each (2x3), or the sizes of unequal groups (2,3,5)", "SIZES"),
    )
    drive: str | None = field(
        default=None,
        metadata=option(
            "close the torque path over virtual drives that speak this protocol; without it the bus only shows the "
            "torques",
            "PROTOCOL",
            choices=_protocols,
        ),
    )
    force: bool = field(default=False, metadata=option("overwrite NAME.toml if it exists"))


def new(options: NewOptions) -> int:
    """Writes a new scenario file."""
    from echelon.cli.new_scenario import scenario_text, sizes

    path = Path(f"{options.name}.toml")
    text = scenario_text(options.name, sizes(options.groups), options.drive)
    try:
        with path.open("w" if options.force else "x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UsageError(f"{path}: exists already; --force overwrites it") from None
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    print(path)
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidateOptions(ScenarioOptions):
    """Options of `echelon validate`."""

    strict: bool = field(default=False, metadata=option("exit with code 2 if there are warnings"))
    json: bool = field(default=False, metadata=JSON)


def validate(options: ValidateOptions) -> int:
    """Checks a scenario; prints what it means, and warnings about what is allowed but probably not intended."""
    from echelon.bridge.timing.fit import describe_fit
    from echelon.cli.scenario_file import read_scenario
    from echelon.sim.forecast.warnings import warnings
    from echelon.sim.results.verdict import count
    from echelon.sim.wall_load import wall_load

    scenario, plan = read_scenario(options.scenario, options.overrides)
    load = wall_load(plan, frames=True)
    facts: dict[str, Any] = {
        "scenario": scenario.name,
        "robots": len(plan.robots),
        "groups": len(plan.nodes) - 1,
        "duration": plan.duration_ns / 1e9,
        "ticks": plan.duration_ns // plan.robots[0].period_ns,
        "time_scales": {block.name: block.sigma for block in plan.blocks},
        "can": list(describe_fit(plan)) if plan.can.enabled else ["disabled"],
        "warnings": warnings(plan),
        "wall_clock": {"load": load.share, "processors": load.processors, "robots_that_fit": load.most},
    }
    code = 2 if options.strict and facts["warnings"] else 0
    if options.json:
        print(json.dumps(facts, indent=2, ensure_ascii=False))
        return code
    print(f"{options.scenario}: valid")
    members = f"{count(facts['robots'], 'robot')}, {count(facts['groups'], 'leader')}, 1 coordinator"
    print(f"  {members}, {facts['duration']:g} s, {count(facts['ticks'], 'tick')}")
    print("  σ  " + "  ".join(f"{name} {sigma:g} s" for name, sigma in facts["time_scales"].items()))
    for line in facts["can"]:
        print(f"  CAN  {line}")
    if load.warning:
        print(f"  {load.warning}")
    for line in facts["warnings"]:
        print(f"  warning  {line}")
    return code


@dataclass(frozen=True, slots=True, kw_only=True)
class DbcOptions(ScenarioOptions):
    """Options of `echelon dbc`."""

    bus: str | None = field(default=None, metadata=option("name of the bus, if the scenario has several", "NAME"))
    json: bool = field(default=False, metadata=option("print JSON: an object with the DBC of each bus by its name"))


def dbc(options: DbcOptions) -> int:
    """Prints the DBC of a bus: what the frames of its drives mean."""
    from echelon.bridge.protocols.plan_dbc import plan_dbc
    from echelon.cli.scenario_file import read_scenario

    _, plan = read_scenario(options.scenario, options.overrides)
    names = [bus.name for bus in plan.can.buses]
    if options.bus not in (None, *names):
        raise UsageError(f"--bus {options.bus}: must be one of {', '.join(names)}")
    wanted = [number for number, name in enumerate(names) if options.bus in (None, name)]
    if options.json:
        print(json.dumps({names[number]: plan_dbc(plan, number) for number in wanted}, indent=2))
        return 0
    if len(wanted) > 1:
        raise UsageError(
            f"{options.scenario} has several buses, each with a DBC of its own: give --bus {' or '.join(names)}"
        )
    sys.stdout.write(plan_dbc(plan, wanted[0]))
    return 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SchemaOptions:
    """Options of `echelon schema`."""

    what: Literal["scenario", "summary", "analysis"] = field(
        metadata=argument(
            "scenario: the keys of scenario files; summary: those of a run's summary.json; analysis: those of "
            "`echelon analyse --json`",
            "WHAT",
        )
    )
    markdown: bool = field(
        default=False, metadata=option("for scenario: print a reference page for people, in Markdown")
    )


def schema(options: SchemaOptions) -> int:
    """Prints the schema of scenario files, of summary.json or of an analysis."""
    from echelon.scenario.schema import reference_page, scenario_schema
    from echelon.sim.parts.loading import REGISTRY
    from echelon.sim.results.rendering import analysis_schema, summary_schema

    if options.markdown and options.what != "scenario":
        raise UsageError(f"--markdown: is only for the schema of scenarios, not of {options.what}")
    if options.markdown:
        sys.stdout.write(reference_page(REGISTRY))
    else:
        schemas = {
            "scenario": lambda: scenario_schema(REGISTRY), "summary": summary_schema, "analysis": analysis_schema
        }  # fmt: skip
        print(json.dumps(schemas[options.what](), indent=2, ensure_ascii=False))
    return 0


COMMANDS: Final[tuple[Command[Any], ...]] = (
    Command(
        name="scenarios",
        options=ScenariosOptions,
        work=scenarios,
        about="Lists the scenarios that come with echelon.  Every command takes their names.",
        examples={
            "echelon scenarios": "names and descriptions",
            "echelon scenarios --json": "also the paths of their files, to read or to copy them",
        },
        codes={0: "done"},
    ),
    Command(
        name="new",
        options=NewOptions,
        work=new,
        about="""\
Writes NAME.toml: a scenario to begin with.  It is valid, its verdict is HOLDS, and each part has
a comment.  Change it, then check it with `echelon validate NAME.toml`.""",
        examples={
            "echelon new my": "my.toml, two groups of three robots",
            "echelon new mine --groups 2x3 --drive odrive": "torques go over a CAN bus to ODrives and back",
            "echelon new ours --groups 2,3,5": "groups of unequal size",
        },
        codes={0: "written"},
    ),
    Command(
        name="validate",
        options=ValidateOptions,
        work=validate,
        about="""\
Checks a scenario.  Prints what it means: robots, duration, time scales, whether its frames fit
its CAN buses.  Or prints all its mistakes, one line each: key, value, and what is allowed.
Prints warnings, one line each, about what is allowed but probably not intended: time scales
near the period, more torque or speed than the robots have, claims about times after the end,
delays that time-driven members round up to whole periods.""",
        examples={
            "echelon validate lab": "a shipped scenario",
            "echelon validate my.toml --set law.lead=0.5": "a file with one value changed",
            "echelon validate my.toml --strict": "fails if there is a warning",
            "echelon validate runs/demo --json": "the scenario of a run, for scripts",
        },
        codes={0: "valid", 2: "not valid; with --strict also if there are warnings"},
    ),
    ANALYSE,
    Command(
        name="dbc",
        options=DbcOptions,
        work=dbc,
        about="""\
Prints what the frames of a scenario's drives mean, as a DBC for cantools, SavvyCAN, Wireshark
and the like.  A run writes the same file into its folder.""",
        examples={
            "echelon dbc lab > torque.dbc": "the scenario has one bus",
            "echelon dbc drives --bus can1": "the scenario has several buses",
            "echelon dbc runs/demo": "the scenario of a run",
        },
        codes={0: "printed"},
    ),
    Command(
        name="schema",
        options=SchemaOptions,
        work=schema,
        about="""\
Prints the JSON schema of scenario files, of summary.json, or of what `echelon analyse --json`
prints.  With the schema of scenarios an editor completes keys, shows what they mean, and marks
mistakes.  In VS Code (Even Better TOML), in
Helix and in Zed (taplo), this line at the top of a scenario names it:
  #:schema ./scenario.schema.json""",
        examples={
            "echelon schema scenario > scenario.schema.json": "for editors",
            "echelon schema scenario --markdown": "all keys with their defaults and units, for people",
            "echelon schema summary": "what is in the summary of a run",
            "echelon schema analysis": "what `echelon analyse --json` prints",
        },
        codes={0: "printed"},
    ),
)
