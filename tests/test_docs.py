"""What README and docs/ name is there: links, paths, sections, commands; and docstrings cite sections that exist."""

import re
import shlex
from pathlib import Path

import pytest

from echelon.cli.parser import make_parser
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


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_as_the_command_line_has_them(page: Path) -> None:
    parser = make_parser()
    for block in re.findall(r"```(?:sh|console)\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        for line in block.splitlines():
            words = shlex.split(line.removeprefix("$ ").replace("RUN…", "RUN"), comments=True)
            if words and words[0].rpartition("/")[2] == "echelon":
                ends = [at for at, word in enumerate(words) if word in ("|", ">", "&&", "&")]
                parser.parse_args(words[1 : min(ends, default=len(words))])
