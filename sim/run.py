"""One run from scenario to folder: run it in one process or in many, then write what it leaves.

The folder holds `scenario.toml` (effective), `run.mcap`, `can.log`, `torque.dbc`, `summary.json` and `report.html`.
"""

import platform
import resource
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import blake2b
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from echelon.bridge.frame_message import frames_of
from echelon.load import effective_toml
from echelon.messages import Channel
from echelon.plan import Plan
from echelon.plugins import PartRunError
from echelon.scenario import Scenario
from echelon.sim.engine import Engine
from echelon.sim.live import Display
from echelon.sim.merge import TimeOrder
from echelon.sim.parts import write_files
from echelon.sim.summary import summarise, write
from echelon.sim.supervisor import Outcome, Progress, Supervisor
from echelon.sim.trace import Trace
from echelon.sim.watchers import Recording

PARTS: Final = ("eclipse-zenoh", "numpy", "python-can", "mcap")
"""Packages whose versions stand in a recording."""
FILES: Final = ("scenario.toml", "run.mcap", "can.log", "torque*.dbc", "summary.json", "report.html")
"""What a run leaves, at most."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A finished run: its folder, its summary, and `failure` if it broke off."""

    folder: Path
    summary: dict[str, Any]
    trace: Trace
    failure: str | None


def new_folder(scenario: Scenario, out: Path | None) -> Path:
    """Makes the folder of a run: `out`, or `runs/<scenario>-<utc time>`; what an earlier run left there goes, so that no
    file of it is taken for this run's.  Raises OSError."""
    if out is None:
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        out = Path("runs") / f"{scenario.name}-{stamp}"
        count = 2
        while out.exists():
            out = Path("runs") / f"{scenario.name}-{stamp}-{count}"
            count += 1
    out.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        for path in out.glob(name):
            path.unlink()
    return out


def execute(
    scenario: Scenario,
    plan: Plan,
    folder: Path,
    *,
    engine: str,
    clock: str,
    can_urls: tuple[str, ...],
    display: Display,
    stall_timeout_s: float = 30.0,
) -> Finished:
    """Runs a plan and writes the run's folder, except for the report.  Raises OSError if a file cannot be written, and
    ValueError too if, in one process, the bus cannot be had."""
    toml = effective_toml(scenario)
    (folder / "scenario.toml").write_text(toml, encoding="utf-8")
    write_files(plan, folder)
    metadata = {
        "scenario": scenario.name,
        "engine": engine,
        "clock": clock,
        "echelon": version("echelon"),
        "python": platform.python_version(),
    } | {part: version(part) for part in PARTS}
    if engine == "inprocess":
        outcome = _in_process(plan, folder, clock, can_urls, toml, metadata, display)
    else:
        outcome = Supervisor(
            plan,
            folder,
            run=blake2b(f"{folder.resolve()} {time.time_ns()}".encode(), digest_size=8).hexdigest(),
            virtual=clock == "virtual",
            can_urls=can_urls,
            scenario_toml=toml,
            metadata=metadata,
            show=display.show,
            stall_timeout_s=stall_timeout_s,
        ).run()
    if outcome.can and "referee" not in outcome.can:
        try:
            outcome.can["referee"] = judged(folder / "can.log", plan, clock, whole=not outcome.failure)
        except PartRunError as error:
            outcome.failure = outcome.failure or str(error)
    display.close()
    summary = summarise(outcome.trace, outcome.links, outcome.can, _run_facts(plan, outcome, engine, clock))
    if outcome.failure:
        verdict = summary["verdict"]
        verdict["holds"] = False
        verdict["reasons"].insert(0, outcome.failure.splitlines()[0])
    write(summary, folder / "summary.json")
    return Finished(folder, summary, outcome.trace, outcome.failure)


def judged(log: Path, plan: Plan, clock: str, whole: bool) -> dict[str, Any]:
    """Returns what the referee finds in a run's can.log."""
    from echelon.bridge.referee import judge_log

    tolerance_ns = plan.can.watchdog_ns // 2 if clock == "wall" else None
    return judge_log(log, plan, tolerance_ns=tolerance_ns, whole=whole) | {"source": "can.log"}


def _in_process(
    plan: Plan,
    folder: Path,
    clock: str,
    can_urls: tuple[str, ...],
    toml: str,
    metadata: dict[str, str],
    display: Display,
) -> Outcome:
    """The in-process engine with recorder and bridge beside it, in the same order of messages as between processes."""
    recording = Recording(folder, plan, toml, metadata)
    gathered: list[Any] = []
    engine = Engine(plan, gathered.append)
    station: Any = None
    if plan.stations:
        from echelon.bridge.closed import ClosedStation
        from echelon.bridge.commander import Commander

        commander = engine.roles[plan.stations[0].index]
        assert isinstance(commander, Commander)
        station = ClosedStation(plan, can_urls, folder, paired=False, role=commander)
    elif can_urls:
        from echelon.bridge.station import Station

        station = Station(plan, can_urls, folder)
    order = TimeOrder(range(len(plan.everyone) if plan.stations else len(plan.members) + bool(can_urls)))
    progress = Progress(phase="running", started_s=time.monotonic())
    if station is not None:
        progress.can["url"] = station.url
    begun_s = shown_s = time.monotonic()
    failure: str | None = None

    def pass_on() -> None:
        if plan.stations:
            for message in gathered:
                if message.channel is Channel.FRAMES and message.source == station.index:
                    station.show(frames_of(message))
        elif station is not None:
            gathered.extend(station.put(gathered))  # robots speak in their order, instant by instant
        recording.add(order.push(gathered))
        gathered.clear()

    try:
        for time_ns in engine.instants():
            if clock == "wall":
                pass_on()
                if (left_s := begun_s + time_ns / 1e9 - time.monotonic()) > 0:
                    time.sleep(left_s)
            elif len(gathered) >= 512:
                pass_on()
            now_s = time.monotonic()
            if now_s - shown_s >= 0.2:
                shown_s = now_s
                _note(progress, recording, station)
                recording.recorder.flush_if_due(time.monotonic_ns())
                display.show(progress)
            if recording.recorder.failure:
                failure = f"the recording failed: {recording.recorder.failure}"
                break
    except PartRunError as error:
        failure = str(error)
    except KeyboardInterrupt:
        failure = "interrupted"
        if plan.stations:
            station.rail.stopping.set()  # a bus that takes no frames is not waited for any more
    wall_s = time.monotonic() - begun_s
    try:
        pass_on()
    except (SystemExit, PartRunError):
        pass
    recording.add(order.rest())
    links = engine.link_counts()
    recording.close(links)
    try:
        if plan.stations:
            station.stop_wheels(station.role.next_ns)
    except PartRunError as error:
        failure = failure or str(error)
    if station is not None:
        station.close()
    result = recording.result()
    failure = failure or (f"the recording failed: {result['failure']}" if result["failure"] else None)
    return Outcome(
        trace=result["trace"],
        links=links,
        results=[],
        can=_can_result(engine, station),
        startup_s=0.0,
        wall_s=wall_s,
        messages=result["messages"],
        failure=failure,
    )


def _can_result(engine: Engine, station: Any) -> dict[str, Any]:
    if station is None:
        return {}
    result: dict[str, Any] = station.result()
    if engine.plan.stations[1:]:
        from echelon.bridge.buses import merge_rows
        from echelon.bridge.drive_bank import DriveBank

        drives = engine.roles[engine.plan.stations[1].index]
        assert isinstance(drives, DriveBank)
        result["drives"] = drives.result()
        merge_rows(result["buses"], drives.lost_rows())
    return result


def _note(progress: Progress, recording: Any, station: Any) -> None:
    news = recording.progress()
    progress.time_ns, progress.messages = news["time_ns"], news["messages"]
    progress.states, progress.states_ns = news["states"], news["states_ns"]
    if station is not None:
        progress.can.update(station.progress())


def _run_facts(plan: Plan, outcome: Outcome, engine: str, clock: str) -> dict[str, Any]:
    common_ns, _ = outcome.trace.common()
    # Robots move on through the period that begins at the last instant: so much was simulated.
    simulated_s = (int(common_ns[-1]) + plan.robots[0].period_ns) / 1e9 if len(common_ns) else 0.0
    facts: dict[str, Any] = {
        "engine": engine,
        "clock": clock,
        "wall_time": outcome.wall_s,
        "startup_time": outcome.startup_s,
        "real_time_factor": simulated_s / outcome.wall_s if outcome.wall_s > 0 else None,
        "ticks_per_second": simulated_s * 1e9 / plan.robots[0].period_ns / outcome.wall_s
        if outcome.wall_s > 0
        else None,
        "messages": outcome.messages,
        "failure": outcome.failure,
    }
    runners = [result.runner for result in outcome.results if result.runner is not None]
    if runners:
        robots = {robot.name for robot in plan.robots}
        facts["processes"] = {
            result.name: {"cpu_time": result.cpu_s, "resident_bytes": result.resident_bytes}
            for result in outcome.results
        }
        facts["resident_bytes_robot_max"] = max(
            (result.resident_bytes for result in outcome.results if result.name in robots), default=None
        )
        facts["late_stages"] = sum(runner.late for runner in runners)
        facts["stages"] = sum(runner.stages for runner in runners)
        facts["latest"] = max(runner.latest_ns for runner in runners) / 1e9
        facts["refused"] = sum(sum(runner.refused.values()) for runner in runners)
    else:
        facts["resident_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return facts
