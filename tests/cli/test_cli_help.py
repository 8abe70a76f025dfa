"""The help of commands: its examples run, and it is fast.  Completion in shells.  Messages about unexpected errors."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from echelon.cli import main
from echelon.cli.machine import completion_script
from echelon.cli.parser import ENTRIES, FIRST_LOOK, make_parser
from support.runs import ROOT, echelon

BIN = Path(sys.executable).parent
EXAMPLES = sorted(
    {*FIRST_LOOK, *(example for name, entry in ENTRIES.items() for example in entry.command(name).examples)}
)
LONG = (
    "echelon run paper",
    "echelon run lab",
    "echelon run drives",
    "echelon drives",
    "echelon observe",
    "echelon completion bash",
    "echelon sweep lab --set duration=30",
    "echelon study",
)
"""Beginnings of the examples that take long, or need a run that goes on.  They are not run, nor are those with `vcan0`, which
need that interface."""
QUICK = [example for example in EXAMPLES if not example.startswith(LONG) and "vcan0" not in example]


def run_in_shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs a command line as a user types it."""
    command = ["bash", "-c", f"export PATH={shlex.quote(str(BIN))}:$PATH; {line}"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder with three runs, a sweep and a scenario."""
    folder = tmp_path_factory.mktemp("user")
    quick = ("--set", "duration=0.5", "--set", "claims=[]", "--engine", "inprocess", "--quiet")
    for name in ("demo", "avoiding"):
        done = echelon("run", "lab", *quick, "--out", f"runs/{name}", cwd=folder)
        assert done.returncode == 0, done.stderr
    on_a_wall_clock = ("--clock", "wall", "--can", "none", *quick[:4], "--quiet", "--out", "runs/real")
    assert echelon("run", "lab", *on_a_wall_clock, cwd=folder).returncode in (0, 1)
    assert echelon("latencies", "runs/real", cwd=folder).returncode == 0
    several = ("--set", "duration=3", "--vary", "law.lead=0:1:0.5", "--quiet", "--out", "runs/many")
    assert echelon("sweep", "lab", *several, cwd=folder).returncode == 0
    assert echelon("new", "my", "--groups", "1x2", cwd=folder).returncode == 0
    (folder / "my.toml").rename(folder / "kept.toml")
    return folder


@pytest.mark.parametrize("example", QUICK)
def test_an_example_runs_as_it_stands(example: str, folder: Path) -> None:
    (folder / "my.toml").unlink(missing_ok=True)
    if "new my" not in example:
        (folder / "my.toml").write_text((folder / "kept.toml").read_text())
    done = run_in_shell(example, folder)
    allowed = (0, 1) if "doctor" in example else (0,)  # 1 if this machine lacks something
    allowed = (1,) if example.startswith("echelon replay") and "--set" in example else allowed
    assert done.returncode in allowed, done.stdout + done.stderr
    assert done.stdout or ">" in example or example.startswith("source")


@pytest.mark.parametrize("example", [example for example in EXAMPLES if not example.startswith("source")])
def test_an_example_is_a_command_with_its_options(example: str) -> None:
    words = shlex.split(example.partition(" < ")[0].partition(" > ")[0])
    parsed = make_parser().parse_args(words[1:])
    assert parsed.command.name == words[1]


@pytest.mark.parametrize("name", ENTRIES)
def test_the_help_of_a_command_says_what_it_does_with_examples_and_exit_codes(name: str) -> None:
    command = ENTRIES[name].command(name)
    done = echelon(name, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert command.about in done.stdout
    assert 2 <= len(command.examples) <= 5
    assert all(f"  {example}" in done.stdout for example in command.examples)
    last = done.stdout.splitlines()[-1]
    assert last.startswith("exit codes: 0 ")
    assert all(f" {code} {meaning}" in last for code, meaning in command.codes.items())
    assert max(map(len, command.about.splitlines())) <= 100


def test_every_command_is_in_the_list() -> None:
    families = {entry.family for entry in ENTRIES.values()}
    assert sorted(command.name for family in families for command in family()) == sorted(ENTRIES)


def test_options_are_there_at_once() -> None:
    heavy = ["numpy", "scipy", "pydantic", "rich", "matplotlib", "cantools", "can", "zenoh", "mcap", "tomlkit", "shtab"]
    code = f"""
import sys
from echelon.cli.parser import make_parser
make_parser()
print(*[name for name in {heavy} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, cwd=ROOT)
    assert (done.stdout, done.stderr) == ("\n", "")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "echelon: the following arguments are required: COMMAND"),
        (("rnu", "lab"), "echelon: argument COMMAND: invalid choice: 'rnu'"),
        (("run",), "echelon run: the following arguments are required: SCENARIO"),
        (("run", "lab", "--clock", "sun"), "echelon run: argument --clock: invalid choice: 'sun'"),
        (("run", "lab", "--engnie", "x"), "echelon: unrecognized arguments: --engnie x"),
        (("referee", "lab", "--tolerance", "x"), "echelon referee: argument --tolerance: 'x' is no number"),
        (("new", "Ab"), "echelon: Ab.toml: name = 'Ab': a name is a lower-case letter"),
        (
            ("new", "a", "--groups", "0x3"),
            "echelon: --groups 0x3: must be the number of groups x robots in each, like 2x3",
        ),
        (("new", "a", "--groups", "2x"), "echelon: --groups 2x: must be"),
        (("new", "a", "--groups", "x3"), "echelon: --groups x3: must be"),
        (("new", "a", "--groups", "2,,3"), "echelon: --groups 2,,3: must be"),
        (("new", "a", "--groups", "2x²"), "echelon: --groups 2x²: must be"),
        (("new", "a", "--groups", "16x8"), "echelon: --groups 16x8: 128 robots, but a bus has identifiers for 127"),
        (("new", "a", "--groups", "999x127"), "echelon: --groups 999x127: 126873 robots"),
        (("schema", "results"), "echelon schema: argument WHAT: invalid choice: 'results'"),
    ],
)
def test_a_mistake_in_the_arguments_is_one_line(arguments: tuple[str, ...], says: str, tmp_path: Path) -> None:
    done = echelon(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(says)
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.iterdir())


# Unexpected errors


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes every command raise an error that nobody expects."""

    def fails(*_: object) -> None:
        raise RuntimeError("a mistake\nof ours")

    monkeypatch.setattr("echelon.cli.scenario_file.read_scenario", fails)


@pytest.mark.usefixtures("broken")
def test_an_unexpected_error_is_one_line_that_says_where_it_was_and_how_to_see_more(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["dbc", "lab"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(r"echelon: RuntimeError: a mistake\nof ours (")
    assert ".py:" in line
    assert line.endswith("; --debug or ECHELON_DEBUG=1 shows the traceback)")


@pytest.mark.usefixtures("broken")
@pytest.mark.parametrize("words", [["--debug", "dbc", "lab"], ["dbc", "--debug", "lab"], ["dbc", "lab"]])
def test_the_traceback_is_shown_to_those_who_ask(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if "--debug" not in words:
        monkeypatch.setenv("ECHELON_DEBUG", "1")
    assert main(words) == 3
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Traceback (most recent call last):"
    assert lines[-2:] == ["RuntimeError: a mistake", "of ours"]


# Completion

BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(( $# - 1 ))
$(complete -p echelon | sed 's/.*-F \\([^ ]*\\).*/\\1/')
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A file with the completion script for bash."""
    path = tmp_path_factory.mktemp("completion") / "echelon.bash"
    done = echelon("completion", "bash")
    assert done.returncode == 0, done.stderr
    path.write_text(done.stdout)
    return path


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("re", ["recover", "referee", "replay", "report"]),
        ("run --e", ["--engine"]),
        ("run --engine in", ["inprocess"]),
        ("run th", ["three_levels"]),
        ("run lab --set x=1 --cl", ["--clock"]),
        ("run lab --clock w", ["wall"]),
        ("new x --drive o", ["odrive"]),
        ("completion ", ["bash", "fish", "zsh"]),
        ("validate my", ["my.toml"]),
        ("report ru", ["runs"]),
        ("replay ru", ["runs"]),
        ("diff runs ru", ["runs"]),
        ("replay runs --scenario u", ["unequal"]),
        ("doctor u", ["unequal"]),
    ],
)
def test_bash_completes(typed: str, completed: list[str], bash_script: Path, folder: Path) -> None:
    (folder / "my.toml").write_text("")
    command = ["bash", "-c", BASH, "bash", str(bash_script), "echelon", *typed.split(" ")]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert sorted(done.stdout.split()) == completed, done.stderr


def test_bash_knows_all_commands_and_all_options(bash_script: Path, tmp_path: Path) -> None:
    def complete(*words: str) -> set[str]:
        command = ["bash", "-c", BASH, "bash", str(bash_script), "echelon", *words]
        return set(subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600).stdout.split())

    assert complete("") == set(ENTRIES)
    for name in ENTRIES:
        said = echelon(name, "--help").stdout
        assert complete(name, "--") == set(
            re.findall(r"--[a-z][a-z-]+", said.partition("options:")[2].partition("examples:")[0])
        )


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_scripts_of_other_shells_know_the_commands(shell: str) -> None:
    script = completion_script(shell, make_parser())
    assert all(name in script for name in ENTRIES)
    assert "three_levels" in script
