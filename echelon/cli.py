"""The command line.  Only the parser is here: each command's work is in the module that the table below names, and is
imported when the command is called, so that `--help` is there at once."""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Final, NoReturn

from echelon import __version__

COMMANDS: Final = "echelon.sim.commands"
"""The module with one function per command."""

EPILOG: Final = """\
a first look:
  echelon run paper                     the paper's nine robots, thirteen processes over Zenoh; a report to look at
  echelon run lab --clock wall          nine robots that could be built, in real time, torques on the CAN bus
  echelon run paper --set avoidance.enabled=true --out runs/avoiding
  echelon run drives                    three drive protocols on three CAN buses; wheels get what came over the bus
  echelon doctor lab                    what this machine can do, and whether the scenario fits it
  echelon validate my.toml              what is wrong with a scenario, in one line

exit codes: 0 done and the verdict holds, 1 the verdict fails, 2 the input is wrong, 3 the run could not finish
"""


class _Parser(argparse.ArgumentParser):
    """A parser that says a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


def parser() -> argparse.ArgumentParser:
    """Returns the parser of all commands."""
    top = _Parser(
        prog="echelon",
        description="Groups of wheeled robots in formation: every robot its own process, wheel torques on a CAN bus.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"echelon {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".")

    def scenario(command: argparse.ArgumentParser, optional: bool = False, more: str = "") -> None:
        command.add_argument(
            "scenario",
            nargs="?" if optional else None,
            help=f"a TOML file, or the name of a shipped scenario (paper, lab, …){more}",
        )
        command.add_argument(
            "--set",
            action="append",
            metavar="KEY=VALUE",
            help="override a value, e.g. law.epsilon=[0.1,0.2]; repeatable",
        )

    def listening(command: argparse.ArgumentParser) -> None:
        scenario(command, more=", or the folder of a run")
        command.add_argument("--can", metavar="URL", help="where to listen; of several buses all, with commas between")
        command.add_argument("--seconds", type=_seconds, metavar="S", help="end after so long (default: at Ctrl-C)")
        command.add_argument("--json", action="store_true", help="print JSON")

    run = add("run", "run a scenario; leaves a folder with recording, summary and report")
    scenario(run)
    run.add_argument(
        "--engine",
        choices=["processes", "inprocess"],
        default="processes",
        help="every role its own process over Zenoh (default), or all roles in one process",
    )
    run.add_argument(
        "--clock",
        choices=["virtual", "wall"],
        default="virtual",
        help="virtual: as fast as messages come, bit for bit repeatable (default); wall: paced by real time",
    )
    run.add_argument("--out", type=Path, metavar="DIR", help="folder of the run (default: runs/<scenario>-<utc time>)")
    run.add_argument(
        "--can", metavar="URL", help="socketcan:vcan0, udp_multicast:<group>:<port>, virtual, auto, or none"
    )
    run.add_argument("--json", action="store_true", help="print the summary as JSON")
    run.add_argument("--quiet", action="store_true", help="show no progress")
    run.add_argument("--no-report", action="store_true", help="write no report.html")
    run.add_argument(
        "--stall-timeout",
        type=_seconds,
        default=30.0,
        metavar="S",
        help="give a run up that stands still for so long (virtual time; default: 30)",
    )

    validate = add("validate", "check a scenario and say what it means")
    scenario(validate)
    validate.add_argument("--json", action="store_true", help="print the facts as JSON")

    analyse = add(
        "analyse", "compute how much delay a scenario's control law bears, exactly, as it is sampled and held"
    )
    scenario(analyse)
    analyse.add_argument("--json", action="store_true", help="print the facts as JSON")

    report = add("report", "write the report of a run, or a comparison of several")
    report.add_argument("runs", nargs="+", metavar="RUN", help="a run's folder")
    report.add_argument("--out", type=Path, metavar="FILE", help="where to write it (default: report.html)")

    export = add("export", "write a run as CSV: robots.csv, blocks.csv, links.csv")
    export.add_argument("run", metavar="RUN", help="a run's folder")
    export.add_argument("--csv", type=Path, required=True, metavar="DIR", help="folder for the files")

    recover = add("recover", "mend a recording that was cut off")
    recover.add_argument("file", type=Path, help="an MCAP file")
    recover.add_argument("--out", type=Path, metavar="FILE", help="where to write it (default: <file>-recovered.mcap)")

    dbc = add("dbc", "print the DBC of a scenario's drives, for cantools, SavvyCAN and the like")
    scenario(dbc)
    dbc.add_argument("--bus", metavar="NAME", help="which of the scenario's buses, if it has several")

    drives = add("drives", "run the virtual drives of a scenario alone, on a bus in real time, to try hosts on")
    scenario(drives)
    drives.add_argument("--can", metavar="URL", help="socketcan:vcan0, udp_multicast:<group>:<port>, or auto")
    drives.add_argument("--seconds", type=_seconds, metavar="S", help="end after so long (default: with Ctrl-C)")

    doctor = add("doctor", "say what this machine can do, and whether a scenario fits it")
    scenario(doctor, optional=True)
    doctor.add_argument("--json", action="store_true", help="print the findings as JSON")

    can = add("can", "show what is on a scenario's CAN buses, wheel by wheel; or what was, at the end of a run")
    listening(can)
    can.add_argument("--speed", type=float, metavar="X", help="replay a run's can.log, X times as fast as it was")

    referee = add(
        "referee", "listen to a scenario's CAN buses, or read a run's can.log, and say what breaks the contract"
    )
    listening(referee)
    referee.add_argument(
        "--tolerance", type=float, metavar="S", help="how late a cyclic frame may be, live (default: half its period)"
    )
    return top


def _seconds(text: str) -> float:
    """A duration [s] as an argument."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is no duration in seconds, more than 0")
    return seconds


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parsed = parser().parse_args(arguments)
    try:
        commands = import_module(COMMANDS)
        try:
            return int(getattr(commands, parsed.command)(parsed))
        except commands.UsageError as error:
            print(f"echelon: {error}", file=sys.stderr)
            return 2
        except commands.PartRunError as error:
            print(f"echelon: {error}", file=sys.stderr)
            return 3
    except BrokenPipeError:  # a reader such as head that has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except KeyboardInterrupt:
        print("echelon: interrupted", file=sys.stderr)
        return 3


if __name__ == "__main__":
    sys.exit(main())
