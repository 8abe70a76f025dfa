"""The parser of the command line: the list of all commands, and the layout of their help.

The module that defines a command is imported only when that command was typed, so that `--help` answers at once.
"""

import sys
from argparse import SUPPRESS, ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

from echelon import __version__

if TYPE_CHECKING:
    from echelon.cli.options import Command

Commands = Sequence["Command[Any]"]
ABOUT: Final = "Groups of wheeled robots in formation: every robot its own process, wheel torques on a CAN bus."
FIRST_LOOK: Final = {
    "echelon run paper": "the paper's nine robots, thirteen processes over Zenoh; a report to look at",
    "echelon run lab --clock wall": "nine robots that could be built, in real time, torques on the CAN bus",
    "echelon run drives": "three drive protocols on three CAN buses; wheels get what came over the bus",
    "echelon scenarios": "the scenarios that are shipped, and what they show",
    "echelon new my --groups 2x3": "my.toml, a scenario of your own to begin with",
    "echelon validate lab": "what a scenario means, or all that is wrong with it",
    "echelon doctor lab": "what this machine can do, and whether the scenario fits it",
}
CODES: Final = {0: "done, and the verdict holds", 1: "the verdict fails"}
MISTAKES: Final = {2: "the input is wrong", 3: "it could not be done, or not to its end"}
"""Exit codes that mean the same for all commands, unless a command says more about one of them"""
WIDTH: Final = 42
"""Width of the column of examples in the help [characters]; longer examples have a line of their own"""


def _run() -> Commands:
    from echelon.cli.run import COMMANDS

    return COMMANDS


def _scenario() -> Commands:
    from echelon.cli.scenario import COMMANDS

    return COMMANDS


def _sweep() -> Commands:
    from echelon.cli.sweep import COMMANDS

    return COMMANDS


def _studies() -> Commands:
    from echelon.cli.studies import COMMANDS

    return COMMANDS


def _results() -> Commands:
    from echelon.cli.results import COMMANDS

    return COMMANDS


def _recordings() -> Commands:
    from echelon.cli.recordings import COMMANDS

    return COMMANDS


def _observe() -> Commands:
    from echelon.cli.observe import COMMANDS

    return COMMANDS


def _bus() -> Commands:
    from echelon.cli.bus import COMMANDS

    return COMMANDS


def _machine() -> Commands:
    from echelon.cli.machine import DOCTOR, completion

    return DOCTOR, completion(make_parser)


class Entry(NamedTuple):
    """A command in the list of commands: its summary in one line, and the function that imports its definition."""

    summary: str
    family: Callable[[], Commands]

    def command(self, name: str) -> "Command[Any]":
        """Returns the definition of the command with this name, which the family must have."""
        return next(command for command in self.family() if command.name == name)


ENTRIES: Final = {
    "run": Entry("run a scenario; leaves a folder with recording, summary and report", _run),
    "scenarios": Entry("list the shipped scenarios", _scenario),
    "new": Entry("write a scenario of your own to begin with", _scenario),
    "validate": Entry("check a scenario and say what it means", _scenario),
    "analyse": Entry("compute how much delay a scenario's control law bears", _scenario),
    "sweep": Entry("run a scenario many times, with values that vary, and search for what it bears", _sweep),
    "figures": Entry("draw the figures of a sweep, with predictions beside what was measured", _studies),
    "study": Entry("make a study: sweeps, figures, and a finding whose numbers are checked", _studies),
    "dbc": Entry("print the DBC of a scenario's drives, for cantools, SavvyCAN and the like", _scenario),
    "schema": Entry("print the schema of scenario files, for editors, or of summaries", _scenario),
    "report": Entry("write the report of a run, or a comparison of several", _results),
    "export": Entry("write a run's tables as CSV or Parquet", _results),
    "recover": Entry("rebuild what a killed run left, or mend a recording that was cut off", _results),
    "replay": Entry("feed a run's messages to today's roles and say where their outputs differ", _recordings),
    "diff": Entry("say where two runs part: the first instant, message and value", _recordings),
    "latencies": Entry("say how long messages took on a wall clock, and write traces of it", _recordings),
    "observe": Entry("print the messages of a run that goes on", _observe),
    "drives": Entry("run the virtual drives of a scenario alone, to try hosts on", _bus),
    "can": Entry("show what is on a scenario's CAN buses, wheel by wheel", _bus),
    "referee": Entry("say what breaks the contract on a scenario's CAN buses", _bus),
    "doctor": Entry("say what this machine can do, and whether a scenario fits it", _machine),
    "completion": Entry("print a script that completes commands and options in a shell", _machine),
}


class Call(NamedTuple):
    """A command with its options.  `work` runs it and returns the exit code; `debug` is the option `--debug`; `live` is that of
    the command."""

    work: Callable[[], int]
    debug: bool
    live: bool


def read(arguments: Sequence[str] | None = None) -> Call:
    """Returns the command and options in these arguments, by default those of the process.

    Ends the process for `--help` (exit code 0) and for wrong arguments (2), as argparse does."""
    words = sys.argv[1:] if arguments is None else arguments
    parsed = make_parser([name for name in ENTRIES if name in words]).parse_args(words)
    command: Command[Any] = parsed.command
    options = command.read_options(parsed)
    return Call(lambda: command.work(options), parsed.debug, command.live)


def make_parser(names: Collection[str] = ENTRIES.keys()) -> ArgumentParser:
    """Returns the parser of all commands.  Only the commands with these names get their options and their help."""
    top = _Parser(
        prog="echelon", description=ABOUT, epilog=_epilog("a first look", FIRST_LOOK, CODES), formatter_class=_Help
    )
    top.add_argument("--version", action="version", version=f"echelon {__version__}")
    debug = "show the traceback of an unexpected error, or of an error in a part of yours"
    top.add_argument("--debug", action="store_true", help=debug)
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    for name, entry in ENTRIES.items():
        parser = commands.add_parser(name, help=entry.summary, formatter_class=_Help)
        if name in names:
            command = entry.command(name)
            parser.description, parser.epilog = command.about, _epilog("examples", command.examples, command.codes)
            command.add_options(parser)
            parser.add_argument("--debug", action="store_true", default=SUPPRESS, help=debug)
            parser.set_defaults(command=command)
    return top


class _Help(RawDescriptionHelpFormatter):
    """Formats help with a left column that is wide enough for the names of all commands."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)
        self._action_max_length = max(map(len, ENTRIES)) + 4


class _Parser(ArgumentParser):
    """A parser that reports a mistake in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def _epilog(title: str, examples: Mapping[str, str], codes: Mapping[int, str]) -> str:
    """Returns the end of a help text: examples with their purposes in a second column, and the exit codes."""
    lines = [f"{title}:"]
    for example, purpose in examples.items():
        lines += (
            [f"  {example:<{WIDTH}}{purpose}"] if len(example) < WIDTH else [f"  {example}", f"  {'':{WIDTH}}{purpose}"]
        )
    meanings = sorted({**MISTAKES, **codes}.items())
    lines += ["", "exit codes: " + ", ".join(f"{code} {meaning}" for code, meaning in meanings)]
    return "\n".join(lines)
