"""Commands about the machine and the shell: `doctor`, `completion`."""

import json
from argparse import Action, ArgumentParser
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal

from echelon.cli.options import Command, argument
from echelon.cli.shared import JSON, OVERRIDES, SCENARIO


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorOptions:
    """Options of `echelon doctor`."""

    scenario: str | None = field(
        default=None,
        metadata=argument(f"check also whether this machine can run this scenario: {SCENARIO}", "SCENARIO"),
    )
    overrides: tuple[str, ...] = field(default=(), metadata=OVERRIDES)
    json: bool = field(default=False, metadata=JSON)


def doctor(options: DoctorOptions) -> int:
    """Checks this machine and prints the results.  Returns exit code 1 if something is missing that every run needs."""
    from echelon.cli.scenario_file import read_scenario
    from echelon.sim.doctor.doctor import examine, text

    plan = read_scenario(options.scenario, options.overrides)[1] if options.scenario else None
    findings = examine(plan)
    if options.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        print(text(findings))
    return 1 if any(finding.state == "problem" for finding in findings) else 0


DOCTOR: Final = Command(
    name="doctor",
    options=DoctorOptions,
    work=doctor,
    about="""\
Tries what a run needs: Python and packages, processors, Zenoh, CAN interfaces, buffers, disk.
With a scenario, it also checks whether its frames fit its buses, and whether this machine keeps
its period in real time.  Gives advice where something is missing.  It changes nothing and needs
no root.""",
    examples={
        "echelon doctor": "this machine",
        "echelon doctor lab": "and whether it can run the lab's nine robots in real time",
        "echelon doctor my.toml --json": "for scripts",
    },
    codes={0: "usable", 1: "not usable"},
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CompletionOptions:
    """Options of `echelon completion`."""

    shell: Literal["bash", "zsh", "fish"] = field(metadata=argument("the shell", "SHELL"))


def completion_script(shell: str, parser: ArgumentParser) -> str:
    """Returns a script with which `shell` completes commands, options, their values, shipped scenarios and files."""
    import shtab

    from echelon.shipped import shipped

    names, own = " ".join(shipped()), "_echelon_scenarios_and_files"
    scenarios = {"bash": own, "zsh": own, "fish": f"({own})"}
    preamble = {
        "bash": f'{own}() {{ compgen -W "{names}" -- "$1"; compgen -f -- "$1"; }}',
        "zsh": f"{own}() {{ compadd {names}; _files }}",
        "fish": f"function {own}; string split ' ' '{names}'; __fish_complete_path (commandline -ct); end",
    }
    places: dict[str, Any] = {"SCENARIO": scenarios, "DIR": shtab.DIRECTORY, "RUN": shtab.DIRECTORY, "FILE": shtab.FILE}
    for action in _actions(parser):
        if action.metavar in places:
            action.complete = places[str(action.metavar)]  # type: ignore[attr-defined]
    return shtab.complete(parser, shell, preamble=preamble[shell])


def _actions(parser: ArgumentParser) -> Iterator[Action]:
    """Yields the arguments of a parser and of all its commands.

    On the way it removes the long descriptions of the commands: completion then shows their summaries in one line."""
    for action in parser._actions:
        yield action
        for command in action.choices.values() if isinstance(action.choices, dict) else ():
            command.description = None
            yield from _actions(command)


def completion(make_parser: Callable[[], ArgumentParser]) -> Command[CompletionOptions]:
    """Returns the command `completion`; `make_parser` makes the parser of all commands when the command is called."""

    def work(options: CompletionOptions) -> int:
        print(completion_script(options.shell, make_parser()))
        return 0

    return Command(
        name="completion",
        options=CompletionOptions,
        work=work,
        about="""\
Prints a script with which your shell completes commands, options, their values, the names of
shipped scenarios, and files.""",
        examples={
            "source <(echelon completion bash)": "in ~/.bashrc",
            "echelon completion zsh > _echelon": "in a folder of $fpath",
            "echelon completion fish > echelon.fish": "in ~/.config/fish/completions",
        },
        codes={0: "printed"},
    )
