"""`echelon run`: from what the user typed to a run, its folder, and the exit code."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from echelon.plan import Plan
from echelon.plugins import PartRunError
from echelon.sim.usage import UsageError, scenario_of


def run(arguments: argparse.Namespace) -> int:
    """`echelon run`"""
    if arguments.engine == "processes":
        from echelon.sim.children import warm_up

        warm_up()
    scenario, plan = scenario_of(arguments)
    from echelon.sim.bus_urls import bus_urls, check_wall_clock
    from echelon.sim.live import Display
    from echelon.sim.results.rendering import json_text
    from echelon.sim.results.summary import summary_text
    from echelon.sim.run import execute, new_folder

    can_urls = bus_urls(plan, arguments.can, arguments.engine == "inprocess")
    if arguments.clock == "wall" and plan.can.closed and (not can_urls or arguments.engine == "inprocess"):
        raise UsageError("can.path = 'closed' with --clock wall: needs --engine processes and a bus")
    if arguments.clock == "wall":
        check_wall_clock(plan, can_urls)
    if plan.can.closed and arguments.engine == "processes" and not can_urls:
        raise UsageError("--can none: the closed torque path of several processes needs a bus; or --engine inprocess")
    if plan.can.closed and arguments.engine == "processes" and any(url.startswith("virtual") for url in can_urls):
        raise UsageError("--can virtual: is inside one process; the closed torque path of several needs another bus")
    if arguments.clock == "virtual" and not plan.can.virtual_drives:
        raise UsageError("can.virtual_drives = false: real drives need --clock wall")
    try:
        folder = new_folder(scenario, arguments.out)
    except OSError as error:
        raise UsageError(f"--out {arguments.out}: {error.strerror}") from None
    display = Display(plan, quiet=arguments.quiet)
    if not arguments.quiet:
        display.say(_heading(plan, arguments, folder, can_urls))
    try:
        finished = execute(
            scenario,
            plan,
            folder,
            engine=arguments.engine,
            clock=arguments.clock,
            can_urls=can_urls,
            display=display,
            stall_timeout_s=arguments.stall_timeout,
        )
    except ValueError as error:
        raise UsageError(str(error)) from None
    except PartRunError as error:  # in one process, a role could not be made
        print(f"echelon: {error}", file=sys.stderr)
        return 3
    except OSError as error:
        print(f"echelon: {error.filename or folder}: {error.strerror or error}", file=sys.stderr)
        return 3
    finally:
        display.close()
    failure = finished.failure
    if not arguments.no_report:
        try:
            from echelon.sim.run_folder import report_on  # matplotlib, when it is needed

            report_on([folder], folder / "report.html")
        except (UsageError, OSError) as error:  # of a run that broke off there may be nothing to report
            failure = failure or f"no report: {error}"
    if arguments.json:
        print(json_text(finished.summary))
    else:
        print(summary_text(finished.summary))
        print(f"  folder   {folder}")
    if failure:
        print(f"echelon: {failure}", file=sys.stderr)
        return 3
    return 0 if finished.summary.verdict.holds else 1


def _heading(plan: Plan, arguments: argparse.Namespace, folder: Path, can_urls: Sequence[str]) -> str:
    robots, nodes = len(plan.robots), len(plan.nodes)
    how = "in one process" if arguments.engine == "inprocess" else f"as {robots + nodes} processes over Zenoh"
    bus = f", frames on {', '.join(can_urls)}" if can_urls else ""
    path = f", {plan.can.path} torque path" if plan.can.closed else ""
    return f"{plan.name}: {robots} robots, {nodes - 1} leaders, 1 coordinator, {how}{path}{bus}; into {folder}"
