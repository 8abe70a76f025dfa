"""What the commands of `echelon` do.  Each takes parsed arguments and returns the exit code.

0: done, and the verdict holds; 1: the verdict fails; 2: the input is wrong; 3: the run could not finish.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from echelon.sim.usage import UsageError, scenario_of


def run(arguments: argparse.Namespace) -> int:
    """`echelon run`"""
    from echelon.sim.run_command import run as work

    return work(arguments)


def validate(arguments: argparse.Namespace) -> int:
    """`echelon validate`"""
    from echelon.bridge.fit import describe_fit

    scenario, plan = scenario_of(arguments)
    facts: dict[str, Any] = {
        "scenario": scenario.name,
        "robots": len(plan.robots),
        "groups": len(plan.nodes) - 1,
        "duration": plan.duration_ns / 1e9,
        "ticks": plan.duration_ns // plan.robots[0].period_ns,
        "time_scales": {block.name: block.sigma for block in plan.blocks},
        "can": list(describe_fit(plan)) if plan.can.enabled else ["disabled"],
    }
    if arguments.json:
        print(json.dumps(facts, indent=2))
    else:
        print(f"{arguments.scenario}: valid")
        print(
            f"  {facts['robots']} robots under {len(plan.nodes)} nodes, {facts['duration']:g} s, {facts['ticks']} ticks"
        )
        print("  σ  " + "  ".join(f"{name} {sigma:g} s" for name, sigma in facts["time_scales"].items()))
        for line in facts["can"]:
            print(f"  CAN  {line}")
    return 0


def report(arguments: argparse.Namespace) -> int:
    """`echelon report`"""
    folders = [Path(run) for run in arguments.runs]
    path = arguments.out or (folders[0] / "report.html" if len(folders) == 1 else Path("report.html"))
    from echelon.sim.run_folder import report_on

    try:
        report_on(folders, path)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None
    print(path)
    return 0


def export(arguments: argparse.Namespace) -> int:
    """`echelon export`"""
    from echelon.sim.export import export_csv
    from echelon.sim.recording import read_links
    from echelon.sim.run_folder import read_run

    folder = Path(arguments.run)
    run_read = read_run(folder)
    try:
        arguments.csv.mkdir(parents=True, exist_ok=True)
        export_csv(run_read.trace, [counts for _, counts in read_links(folder / "run.mcap")], arguments.csv)
    except OSError as error:
        raise UsageError(f"--csv {arguments.csv}: {error.strerror}") from None
    print(arguments.csv)
    return 0


def recover(arguments: argparse.Namespace) -> int:
    """`echelon recover`"""
    from echelon.sim.recording import recover as mend

    target = arguments.out or arguments.file.with_name(arguments.file.stem + "-recovered.mcap")
    try:
        result = mend(arguments.file, target)
    except OSError as error:
        raise UsageError(f"{error.filename or arguments.file}: {error.strerror}") from None
    except ValueError as error:
        raise UsageError(f"{arguments.file}: {error}") from None
    print(f"{target}: {result.messages} messages, up to t = {(result.until_ns or 0) / 1e9:g} s")
    return 0


def dbc(arguments: argparse.Namespace) -> int:
    """`echelon dbc`"""
    from echelon.bridge.plan_dbc import plan_dbc

    _, plan = scenario_of(arguments)
    names = [bus.name for bus in plan.can.buses]
    if arguments.bus not in (None, *names):
        raise UsageError(f"--bus {arguments.bus}: must be one of {', '.join(names)}")
    if arguments.bus is None and len(names) > 1:
        raise UsageError(
            f"{arguments.scenario} has several buses, each with a DBC of its own: give --bus {' or '.join(names)}"
        )
    sys.stdout.write(plan_dbc(plan, 0 if arguments.bus is None else names.index(arguments.bus)))
    return 0


def drives(arguments: argparse.Namespace) -> int:
    """`echelon drives`"""
    from echelon.sim.bus_urls import bus_urls, check_wall_clock
    from echelon.sim.drives_command import run_drives

    arguments.set = [*(arguments.set or ()), "can.path=closed", "can.virtual_drives=true"]
    _, plan = scenario_of(arguments)
    urls = bus_urls(plan, arguments.can, False)
    if not urls or any(url.startswith("virtual") for url in urls):
        raise UsageError("drives without a bus to others: give --can socketcan:vcan0, udp_multicast: or auto")
    check_wall_clock(plan, urls)
    try:
        run_drives(plan, urls, arguments.seconds, lambda line: print(line, flush=True))
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from None
    return 0


def doctor(arguments: argparse.Namespace) -> int:
    """`echelon doctor`"""
    from dataclasses import asdict

    from echelon.sim.doctor import examine, text

    plan = scenario_of(arguments)[1] if arguments.scenario else None
    findings = examine(plan)
    if arguments.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        print(text(findings))
    return 1 if any(finding.state == "problem" for finding in findings) else 0


def analyse(arguments: argparse.Namespace) -> int:
    """`echelon analyse`"""
    from echelon.controller.sampled import delay_margin, largest_stable_delay, linear_gains, spectral_radius

    _, plan = scenario_of(arguments)
    period_s = plan.root.period_ns / 1e9
    try:
        largest = largest_stable_delay(plan, 500)
        radii = {k: spectral_radius(plan, k) for k in ((0,) if largest is None else (largest, largest + 1))}
    except ValueError as error:
        raise UsageError(f"{arguments.scenario}: {error}") from None
    margins = {}
    for block in plan.blocks:
        if block.size:
            gains = linear_gains(plan, block, 0.0)
            margin = delay_margin(*(float(matrix[0, 0]) for matrix in (gains.K_1, gains.K_2, gains.K_i)))
            margins[block.name] = {"sigma": block.sigma, "delay_margin": margin}
    if arguments.json:
        facts = {
            "scenario": plan.name,
            "period": period_s,
            "blocks": margins,
            "largest_stable_delay": None if largest is None else largest * period_s,
            "spectral_radius": radii,
        }
        print(json.dumps(facts, indent=2))
        return 0 if largest is not None else 1
    print(f"{plan.name}: how old robots' states may be when their leaders use them")
    for name, row in margins.items():
        margin_ms = f"{1e3 * row['delay_margin']:.4g} ms"
        print(f"  {name:<12} σ {row['sigma']:<6.4g} s   margin of the block alone, in continuous time: {margin_ms}")
    how = f"all blocks together, sampled and held for {1e3 * period_s:g} ms"
    if largest is None:
        print(f"  {how}: unstable without any delay")
        return 1
    print(f"  {how}: stable up to {largest} ticks, {1e3 * largest * period_s:g} ms")
    for k, radius in radii.items():
        print(f"    {k} ticks: spectral radius {radius:.6f}, {'settles' if radius < 1 else 'does not settle'}")
    return 0


def can(arguments: argparse.Namespace) -> int:
    """`echelon can`"""
    from echelon.sim import can_commands

    return can_commands.can(arguments)


def referee(arguments: argparse.Namespace) -> int:
    """`echelon referee`"""
    from echelon.sim import can_commands

    return can_commands.referee(arguments)
