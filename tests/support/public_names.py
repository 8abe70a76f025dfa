"""What others may rely on, as a page: `make docs` writes docs/public-names.md, a test holds it against the code."""

import ast
import inspect
import re
import textwrap
from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import cached_property

import echelon
from echelon.cli.parser import ENTRIES, MISTAKES, make_parser
from echelon.messages import Channel
from echelon.plugins import Plugin
from echelon.sim.out_folder import run_files
from echelon.sim.parts.loading import REGISTRY
from echelon.sim.results.records import Summary
from echelon.sim.sweep.folder import FILES as SWEEP_FILES
from support.runs import ROOT, plan_of

HEAD = """\
# Public names

What others may rely on, made from the code by `make docs`. A test fails when one of these names changes unnoticed. The keys of
a scenario are in [scenario.md](scenario.md), those of `summary.json` in [summary.schema.json](summary.schema.json), those
of `echelon analyse --json` in [analysis.schema.json](analysis.schema.json); all are made and tested in the same way. What is in
none of these pages is internal and may change.
"""


def page() -> str:
    """Returns the page."""
    sections = {
        "In Python: `import echelon`": _python(),
        "Parts": _parts(),
        "What parts import": _imports(),
        "Commands": _commands(),
        "Exit codes": _exit_codes(),
        "Files of a run": (f"- `{name}`" for name in run_files(plan_of("lab"), bus=True)),
        "Files of a sweep": (f"- `{name}`" for name in SWEEP_FILES),
        "Channels of messages": (f"- `{channel.name}` = {channel.value}" for channel in Channel),
    }
    return HEAD + "".join(f"\n## {title}\n\n" + "\n".join(lines) + "\n" for title, lines in sections.items())


def _python() -> Iterator[str]:
    for name in sorted(echelon.__all__):
        value = getattr(echelon, name)
        if not callable(value):
            yield f"- `{name}`"
            continue
        has_signature = inspect.isfunction(value) or not issubclass(value, (Plugin, Exception, tuple))
        yield f"- `{name}{_signature(value) if has_signature else ''}`"
        if inspect.isclass(value):
            yield from _members(value)


def _members(of: type) -> Iterator[str]:
    if issubclass(of, tuple):
        yield from (f"  - `.{field}`" for field in of._fields)  # type: ignore[attr-defined]
        return
    attributes = {} if issubclass(of, Plugin) else dict.fromkeys(_attributes(of))
    if of is echelon.Run:
        attributes |= dict.fromkeys(field.name for field in fields(Summary))
    for name, member in sorted((attributes | dict(vars(of))).items(), key=lambda item: item[0]):
        if name.startswith("_") or name.startswith("model_"):
            continue
        abstract = " (must be given)" if getattr(member, "__isabstractmethod__", False) else ""
        if inspect.isfunction(member):
            yield f"  - `.{name}{_signature(member)}`{abstract}"
        elif isinstance(member, (property, cached_property)):
            yield f"  - `.{name}`{abstract}"
        elif name in getattr(of, "__annotations__", {}) or name in attributes or isinstance(member, Mapping):
            yield f"  - `.{name}`"


def _attributes(of: type) -> Iterator[str]:
    """Yields the public attributes that methods of a class set."""
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(of)))):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
            yield node.attr


def _signature(value: object) -> str:
    """Returns the names of the arguments and their defaults; types are for mypy."""
    signature = inspect.signature(value)  # type: ignore[arg-type]
    bare = [p.replace(annotation=p.empty) for name, p in signature.parameters.items() if name != "self"]
    return str(inspect.Signature(bare))


def _parts() -> Iterator[str]:
    yield "| entry points | base class | built in |"
    yield "|---|---|---|"
    bases = {"laws": "Law", "plants": "Plant", "trajectories": "Trajectory", "protocols": "DriveProtocol"}
    for name, group in REGISTRY.groups.items():
        assert all(issubclass(part, getattr(echelon, bases[name])) for part in group.built_in.values())
        yield f"| `echelon.{name}` | `echelon.{bases[name]}` | {', '.join(f'`{part}`' for part in group.built_in)} |"


def _imports() -> Iterator[str]:
    """Yields what the examples of parts and the pages about parts import: authors of parts need these modules, too."""
    found: dict[str, set[str]] = {}
    for page in sorted((ROOT / "docs").glob("add-*.md")):
        for module, names in re.findall(r"from (echelon\.[\w.]+) import ([\w, ]+)", page.read_text(encoding="utf-8")):
            found.setdefault(module, set()).update(name.strip() for name in names.split(","))
    for path in sorted((ROOT / "examples").glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("echelon."):
                found.setdefault(str(node.module), set()).update(name.name for name in node.names)
    yield from (f"- `{module}`: {', '.join(f'`{name}`' for name in sorted(found[module]))}" for module in sorted(found))


def _commands() -> Iterator[str]:
    parser = make_parser()
    (commands,) = (action for action in parser._actions if isinstance(action, _SubParsersAction))
    for name in ENTRIES:
        yield f"- `echelon {name}`: {' '.join(f'`{option}`' for option in _options(commands.choices[name]))}"


def _options(parser: ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        yield ", ".join(action.option_strings) or str(action.metavar or action.dest)


def _exit_codes() -> Iterator[str]:
    for name, entry in ENTRIES.items():
        codes = entry.command(name).codes
        yield f"- `echelon {name}`: {'; '.join(f'{code} {meaning}' for code, meaning in codes.items())}"
    yield f"- all: {'; '.join(f'{code} {meaning}' for code, meaning in MISTAKES.items())}"


if __name__ == "__main__":
    print(page(), end="")
