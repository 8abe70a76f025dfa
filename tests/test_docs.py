"""What README and docs/ name is there: links, paths, sections, commands; and docstrings cite sections that exist."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from echelon.cli.new_scenario import scenario_text, sizes
from echelon.cli.parser import make_parser
from echelon.scenario.tables import Scenario
from support.runs import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = [
    path for folder in ("echelon", "agents", "bridge", "controller", "sim") for path in (ROOT / folder).glob("**/*.py")
]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PATH = re.compile(r"`((?:echelon|agents|bridge|controller|sim|tests|deploy|docs|examples|bench)/[\w./*-]*)`")
CITED = re.compile(r"architecture\.md[^0-9)]{0,12}(\d(?:\.\d+)?)")


def anchor(heading: str) -> str:
    """Returns the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def headings(page: Path) -> list[str]:
    return [line.lstrip("#").strip() for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("#")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        path, _, section = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), target
        if section:
            assert section in map(anchor, headings(there)), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_paths_exist(page: Path) -> None:
    for path in PATH.findall(page.read_text(encoding="utf-8")):
        assert list(ROOT.glob(path.rstrip("/"))), path


def test_docstrings_cite_sections_that_exist() -> None:
    numbers = {heading.split()[0] for heading in headings(ROOT / "docs" / "architecture.md")}
    cited = {(number, path.name) for path in SOURCES for number in CITED.findall(path.read_text(encoding="utf-8"))}
    assert len(cited) > 10
    assert {(number, name) for number, name in cited if number not in numbers} == set()


def test_no_docstring_points_outside_the_repository() -> None:
    for path in SOURCES:
        assert "theory.md" not in path.read_text(encoding="utf-8"), path


def tables(page: Path) -> list[str]:
    """Returns the pieces of scenarios on a page that begin with a table."""
    blocks = re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    return [block for block in blocks if block.startswith("[") and not block.startswith("[project")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_of_the_pages_can_be_added_to_the_scenario_of_the_readme(page: Path) -> None:
    """`[law]` and `[trajectory]` take the place of those that are there."""
    mine = (ROOT / "README.md").read_text(encoding="utf-8").split("```toml\n", 1)[1].split("```", 1)[0]
    for table in tables(page):
        replaced = [name for name in ("law", "trajectory") if f"[{name}]" in table]
        kept = re.sub(rf"^\[({'|'.join(replaced) or '-'})\]\n.*?(?=^\[)", "", mine, flags=re.DOTALL | re.MULTILINE)
        known = Scenario.model_fields
        assert set(tomllib.loads(f"{kept}\n{table}")) <= set(known), table


def test_a_new_scenario_has_the_tables_that_pages_name() -> None:
    text = scenario_text("mine", sizes("2x3"), "odrive")
    assert {"[robot]", "[law]", "[trajectory]", "[robot.drive]", "[robot.envelope]"} <= set(text.splitlines())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_as_the_command_line_has_them(page: Path) -> None:
    parser = make_parser()
    for block in re.findall(r"```(?:sh|console)\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        for line in block.splitlines():
            words = shlex.split(line.removeprefix("$ ").replace("RUN…", "RUN"), comments=True)
            if words and words[0].rpartition("/")[2] == "echelon":
                ends = [at for at, word in enumerate(words) if word in ("|", ">", "&&", "&")]
                parser.parse_args(words[1 : min(ends, default=len(words))])
