"""The processes of a run start together, give the results of one process, and end together, for whatever reason."""

import os
import re
import resource
import signal
import stat
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import Process, forkserver, util
from pathlib import Path
from subprocess import Popen

import numpy as np
import pytest

from echelon.bridge.can.log_files import frames_in
from echelon.bridge.protocols.native.codec import BASE_ID
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan
from echelon.runtime.session import Session
from echelon.runtime.wire import data_key, encode, join, watch_key
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import parse
from echelon.sim.processes.children import compiling_pays, warm_up
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.failures import NAMED, few
from echelon.sim.processes.outcome import Outcome, Progress
from echelon.sim.processes.supervisor import Supervisor
from echelon.sim.recording.arrivals import read_arrivals
from echelon.sim.recording.mcap_reader import read_trace, recover
from echelon.sim.results.trace import Trace
from support.arrivals import with_traces
from support.runs import (
    descendants,
    kill_session,
    pid_of,
    plan_of,
    reasons,
    session_members,
    start_echelon,
    summary_of,
    trace_of,
    until,
)

LINKS = 'links=[{channel="state",delay={min=0.0,max=0.003},loss=0.1},{channel="command",delay=0.0012,loss=0.05}]'
EVERY_KIND = (
    'links=[{name="up",channel="state",delay={kind="gamma",shape=2.0,scale=0.004,correlation=0.9},loss={mean=0.2,burst=3.0}},'
    '{name="down",channel="command",delay={kind="normal",mean=0.01,std=0.01},loss=0.2,loss_of="message",duplicates=0.3,policy="zero",timeout=0.05},'
    '{channel="group_state",delay={kind="pareto",min=0.002,shape=1.5},order="fifo",policy="hold_then_stop",timeout=0.04},'
    '{channel="reference",delay={kind="trace",file="TRACE",by="time"}}]',
    'events=[{kind="blackout",at=0.1,duration=0.05,link="down"},{kind="cut_off",at=0.2,duration=0.05,member="g1"}]',
    "robot.clock={offset=0.003,drift=1e-4}",
)
"""Links of every kind but the plain ones; `TRACE` stands for a file"""
LATE = 'links=[{channel="state",delay=5.0},{channel="command",delay=5.0},{channel="reference",loss=1.0}]'
SHORT = "duration=0.3"
TWENTY = """
name = "twenty"
duration = 1000.0
robot = {{ mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }}
law = {{ epsilon = [0.5] }}
trajectory = {{ kind = "line", velocity = [0.1, 0.0] }}
formation.shape = {{ kind = "line", spacing = 1.0 }}
formation.robots = {{ {robots} }}
"""


def supervised(plan: Plan, folder: Path, **options: object) -> Outcome:
    """Runs a plan as processes."""
    return Supervisor(plan, folder, run=f"test-{os.getpid()}-{id(plan)}", virtual=True, **options).run()  # type: ignore[arg-type]


@pytest.fixture
def long_run(tmp_path: Path) -> Iterator[tuple[Popen[str], Path]]:
    """A run that would take minutes and is recording already; remaining processes are killed afterwards."""
    folder = tmp_path / "run"
    command = start_echelon("run", "paper", "--set", "duration=1000", "--can", "virtual", "--quiet", "--out", folder)
    try:
        recording = folder / "run.mcap"
        assert until(lambda: recording.exists() and recording.stat().st_size > 200_000), command.communicate(timeout=5)
        yield command, folder
    finally:
        kill_session(command.pid)
        command.communicate()


def finished(command: Popen[str]) -> tuple[int, str, str]:
    """Waits for the end of a run, and checks that all its processes are gone then or shortly after."""
    out, err = command.communicate(timeout=600)
    assert until(lambda: not session_members(command.pid)), session_members(command.pid)
    return command.returncode, out, err


@pytest.mark.parametrize("links", [(), (LINKS,), (LATE, "duration=2")], ids=["ideal", "delay and loss", "very late"])
def test_processes_give_the_trace_of_one_process(tmp_path: Path, links: tuple[str, ...]) -> None:
    plan = plan_of("paper", SHORT, *links)
    expected = trace_of(plan).digest()
    outcome = supervised(plan, tmp_path)
    assert outcome.failure is None
    assert outcome.trace.digest() == expected
    assert read_trace(tmp_path / "run.mcap", plan).digest() == expected


def test_links_of_every_kind_do_the_same_between_processes(tmp_path: Path) -> None:
    trace = tmp_path / "delays.csv"
    trace.write_text("time,delay\n0,0.011\n0.12,lost\n0.2,0.003\n")
    plan = plan_of("lab", "duration=0.5", *(text.replace("TRACE", str(trace)) for text in EVERY_KIND))
    engine = Engine(plan, lambda message: None)
    engine.run()
    outcome = supervised(plan, tmp_path)
    assert outcome.failure is None
    assert outcome.trace.digest() == trace_of(plan).digest()
    counts = sorted(outcome.links, key=lambda link: (link.receiver, link.source, link.channel))
    assert counts == sorted(engine.link_counts(), key=lambda link: (link.receiver, link.source, link.channel))
    of_channel = {
        channel: [link for link in counts if link.channel is channel] for channel in {link.channel for link in counts}
    }
    for links in of_channel.values():
        assert sum(link.lost for link in links)
        assert all(link.sent == link.delivered + link.lost + link.in_flight for link in links)
    assert sum(link.duplicates for link in of_channel[Channel.COMMAND])


BROUGHT = (
    'links=[{channel="state",delay={min=0.003,max=0.06},loss=0.1,policy="POLICY"},'
    '{channel="group_state",delay={min=0.003,max=0.06},loss=0.1,policy="POLICY"},{channel="command",delay=0.012,loss=0.05}]'
)
"""Late and lossy links; `POLICY` stands for what is done with states"""


@pytest.mark.parametrize(
    ("policy", "timing"),
    [
        ("extrapolate", ('timing="time_driven"',)),
        (
            "predict",
            ('formation.groups.g1.timing="time_driven"', 'formation.groups.g2.robots.r4.timing="time_driven"'),
        ),
    ],
    ids=["extrapolate, time-driven", "predict, one group and one robot time-driven"],
)
def test_policies_and_timings_do_the_same_between_processes(
    tmp_path: Path, policy: str, timing: tuple[str, ...]
) -> None:
    plan = plan_of("lab", "duration=0.5", BROUGHT.replace("POLICY", policy), *timing)
    outcome = supervised(plan, tmp_path)
    assert outcome.failure is None
    assert outcome.trace.digest() == trace_of(plan).digest()
    # each of them makes it another run
    others = [plan_of("lab", "duration=0.5", BROUGHT.replace("POLICY", "hold"), *timing)]
    for left_out in range(len(timing)):
        changes = (*timing[:left_out], *timing[left_out + 1 :])
        others.append(plan_of("lab", "duration=0.5", BROUGHT.replace("POLICY", policy), *changes))
    assert outcome.trace.digest() not in [trace_of(other).digest() for other in others]


def test_links_are_told_while_the_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes tell their links once a second; the run is long enough that none ends before."""
    plan = plan_of("lab", "duration=25.0", 'links=[{channel="state",loss=0.5}]')
    seen: list[int] = []
    outcome = supervised(
        plan, tmp_path, show=lambda progress: seen.append(sum(each.sent for each in progress.links.values()))
    )
    assert outcome.failure is None
    assert seen[-1] <= sum(link.sent for link in outcome.links)
    assert max(seen) > 0


def test_order_of_start_does_not_matter(tmp_path: Path) -> None:
    plan = plan_of("paper", SHORT, LINKS)
    outcome = supervised(plan, tmp_path, order=lambda specs: specs[::-1])
    assert outcome.trace.digest() == trace_of(plan).digest()


def _spin() -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    while True:
        pass


def test_a_busy_core_does_not_matter(tmp_path: Path) -> None:
    plan = plan_of("paper", SHORT, LINKS)
    busy = Process(target=_spin, daemon=True)
    busy.start()
    try:
        outcome = supervised(plan, tmp_path)
    finally:
        busy.kill()
    assert outcome.trace.digest() == trace_of(plan).digest()


@pytest.mark.parametrize("scenario", ["unequal", "three_levels", "multi", "integral", "sliding", "crossing"])
def test_every_tree_gives_the_trace_of_one_process(tmp_path: Path, scenario: str) -> None:
    plan = plan_of(scenario, "duration=0.4", "avoidance.enabled=true")
    outcome = supervised(plan, tmp_path)
    assert outcome.failure is None
    assert outcome.trace.digest() == trace_of(plan).digest()


def test_layers_with_periods_of_their_own(tmp_path: Path) -> None:
    plan = plan_of("paper", SHORT, "formation.period=0.01", "formation.groups.g2.period=0.002", LINKS)
    outcome = supervised(plan, tmp_path)
    assert outcome.failure is None
    assert outcome.trace.digest() == trace_of(plan).digest()


def test_two_runs_at_once_never_meet(tmp_path: Path) -> None:
    plans = [plan_of("paper", "duration=0.5", f"seed={seed}", LINKS) for seed in (1, 2)]
    commands = [
        start_echelon(
            *("run", "paper", "--set", "duration=0.5", "--set", f"seed={seed}", "--set", LINKS),
            *("--can", "none", "--no-report", "--quiet", "--out", tmp_path / str(seed)),
        )
        for seed in (1, 2)
    ]
    for command in commands:
        finished(command)
    digests = [summary_of(tmp_path / str(seed))["trace_digest"] for seed in (1, 2)]
    assert digests == [trace_of(plan).digest() for plan in plans]
    assert digests[0] != digests[1]


def test_the_compiler_is_loaded_where_that_pays() -> None:
    """In a run with many torque periods inside the robots; on the closed path each is an exchange of messages."""
    assert compiling_pays(plan_of("paper"))
    assert not compiling_pays(plan_of("paper", "duration=1", "claims=[]"))
    assert not compiling_pays(plan_of("paper", "can.path=closed", "claims=[]"))
    assert not compiling_pays(plan_of("lab"))


def test_only_this_user_reaches_the_fork_server() -> None:
    """Its socket is a file in a folder of this user's, also with Python 3.11.0 (CVE-2022-42919)."""
    warm_up(plan_of("lab"))
    address = forkserver._forkserver._forkserver_address  # type: ignore[attr-defined]
    assert util.abstract_sockets_supported is False
    assert stat.S_ISSOCK(os.stat(address).st_mode)
    assert stat.S_IMODE(Path(address).parent.stat().st_mode) == 0o700


class Attacker:
    """A program without the run's secrets that connects to each process that listens, in threads of its own.  It hears what it
    can, and forges states of a robot a few periods ahead."""

    def __init__(self, supervisor: Supervisor, plan: Plan) -> None:
        specs = supervisor._specs
        self._run, self._plan = specs[0].run, plan
        self._connect = [endpoint for spec in specs for endpoint in spec.listen]
        self.heard: list[bytes] = []
        self.forged = 0
        self._begun, self._done = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._attack)

    def __enter__(self) -> "Attacker":
        self._thread.start()
        assert self._begun.wait(60)
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._thread.join()

    def _attack(self) -> None:
        robot, run = self._plan.robots[0], self._run
        state = np.full(len(STATE_FIELDS), 3.0)
        with (
            Session(listen=[], connect=self._connect, lockstep=False) as ear,
            Session(listen=[], connect=self._connect, lockstep=False) as mouth,
        ):
            ear.subscribe([f"echelon/{run}/**", f"echelon/{run}/@watch/**"], self.heard.append)
            said = mouth.publisher(data_key(run, robot.path, Channel.STATE))
            copied = mouth.publisher(watch_key(run, "robot", robot.name))
            while not self._done.wait(0.001):
                number = self.forged % (self._plan.duration_ns // robot.period_ns)
                payload = encode(Message(Channel.STATE, robot.index, number, number * robot.period_ns, state))
                said.put(payload)
                copied.put(join([payload]))
                self.forged += 1
                self._begun.set()


@pytest.mark.parametrize("virtual", [True, False])
def test_a_program_without_the_secrets_of_a_run_hears_and_changes_nothing(tmp_path: Path, virtual: bool) -> None:
    plan = plan_of("lab", f"duration={10.0 if virtual else 2.0}")
    supervisor = Supervisor(plan, tmp_path, run=f"attacked-{os.getpid()}", virtual=virtual)
    with Attacker(supervisor, plan) as attacker:
        outcome = supervisor.run()
    assert outcome.failure is None
    assert attacker.forged > 100
    assert not attacker.heard
    if virtual:
        assert outcome.trace.digest() == trace_of(plan).digest()
    else:
        assert np.abs(outcome.trace.common()[1][..., 0] - 3.0).min() > 0
    assert outcome.processes
    assert not outcome.refusals()


A_PERIOD_LATE = 'links=[{source="**", receiver="**", delay=0.05}]'


def test_on_a_wall_clock_each_act_is_at_most_a_period_late_when_nothing_is_late(tmp_path: Path) -> None:
    plan = plan_of("lab", "duration=0.5", "periods.acceleration=0.05", "periods.torque=0.01")
    outcome = Supervisor(plan, tmp_path, run="wall", virtual=False).run()
    assert outcome.failure is None
    runners = [result.runner for result in outcome.processes if result.runner]
    assert len(runners) == 13
    assert outcome.wall_s >= 0.5
    if not sum(runner.late for runner in runners):
        # in virtual time, with each message a whole period on its way
        slowest = plan_of("lab", "duration=0.5", "periods.acceleration=0.05", "periods.torque=0.01", A_PERIOD_LATE)
        bound, difference = (
            np.abs(trace.common()[1] - trace_of(plan).common()[1])[..., :2].max()
            for trace in (trace_of(slowest), outcome.trace)
        )
        assert 0 < difference < bound


def equal_states(recorded: Trace, other: Trace) -> tuple[int, int]:
    """Returns how many states of robots were recorded, and how many of them are the same in another trace, bit for bit."""
    same = 0
    for robot, times_ns in enumerate(recorded.times_ns):
        at = np.searchsorted(other.times_ns[robot], times_ns)
        assert (other.times_ns[robot][at] == times_ns).all()
        same += int((other.states[robot][at] == recorded.states[robot]).all(axis=1).sum())
    return sum(map(len, recorded.times_ns)), same


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        (LINKS, "periods.acceleration=0.002", "periods.torque=0.001"),
        ('timing="time_driven"',),
        ('links=[{channel="state",delay={min=0.0,max=0.03},loss=0.1,policy="hold_then_stop",timeout=0.04}]',),
    ],
    ids=["ideal links", "short periods", "time-driven", "delay and loss"],
)
@pytest.mark.parametrize("busy", [False, True], ids=["", "busy"])
def test_virtual_time_with_the_latencies_of_a_wall_clock_is_that_run(
    overrides: tuple[str, ...], busy: bool, tmp_path: Path
) -> None:
    """However late messages and processes were: the states are those of the run, bit for bit."""
    plan = plan_of("lab", "duration=0.7", *overrides)
    others = [Process(target=_spin, daemon=True) for _ in range(2 * busy)]
    for other in others:
        other.start()
    try:
        for number in range(10):  # a machine that is busy elsewhere withholds most instants, now and then
            folder = tmp_path / str(number)
            folder.mkdir()
            outcome = Supervisor(plan, folder, run="wall", virtual=False).run()
            assert outcome.failure is None
            arrivals = read_arrivals(folder / "arrivals.bin", plan)
            assert not arrivals.damaged
            assert sorted(arrivals.ends_ns) == [one.index for one in plan.formation]
            recorded, same = equal_states(outcome.trace, trace_of(with_traces(plan, arrivals)))
            assert recorded == same
            if recorded > 300:
                break
    finally:
        for other in others:
            other.kill()
    assert recorded > 300
    assert equal_states(outcome.trace, trace_of(plan))[1] < same  # without these latencies it is another run


def test_the_arrivals_at_a_member_that_is_killed_are_kept(tmp_path: Path) -> None:
    plan, killed = plan_of("lab", "duration=100.0"), list[int]()

    def watch(progress: Progress) -> None:
        if progress.time_ns > 700_000_000 and not killed:
            killed.append(pid_of("g2/r5", descendants(os.getpid())))
            os.kill(killed[0], signal.SIGKILL)

    outcome = Supervisor(plan, tmp_path, run="wall", virtual=False, show=watch).run()
    assert outcome.failure is not None
    assert "lost robot g2/r5" in outcome.failure
    arrivals = read_arrivals(tmp_path / "arrivals.bin", plan)
    index = next(robot.index for robot in plan.robots if robot.name == "g2/r5")
    assert sorted({*range(13)} - set(arrivals.ends_ns)) == [index]
    assert 0 < arrivals.known_until_ns(index) < plan.duration_ns


def test_a_lost_robot_ends_the_run_by_name(long_run: tuple[Popen[str], Path]) -> None:
    command, folder = long_run
    os.kill(pid_of("g2/r5", session_members(command.pid)), signal.SIGKILL)
    code, _, err = finished(command)
    assert code == 3
    assert "lost robot g2/r5 (killed by SIGKILL)" in err
    summary = summary_of(folder)
    assert any("lost robot g2/r5" in reason for reason in reasons(summary))
    assert len(read_trace(folder / "run.mcap", plan_of("paper", "duration=1000")).times_ns[0]) > 10


def test_all_that_were_killed_are_named(tmp_path: Path) -> None:
    killed = list[int]()

    def watch(progress: Progress) -> None:
        if progress.time_ns > 200_000_000 and not killed:
            killed.extend(pid_of(name, descendants(os.getpid())) for name in ("g1/r1", "g3", "g2/r5"))
            for pid in killed:
                os.kill(pid, signal.SIGKILL)

    outcome = Supervisor(plan_of("paper", "duration=1000.0"), tmp_path, run="killed", virtual=True, show=watch).run()
    assert outcome.failure is not None
    first, _, others = outcome.failure.partition("; lost as well: ")
    assert first.startswith("lost ")
    said = {first.removeprefix("lost "), *others.split(", ")}
    assert said == {f"{who} (killed by SIGKILL)" for who in ("robot g1/r1", "leader g3", "robot g2/r5")}


def test_last_words_of_a_process_that_fails(tmp_path: Path) -> None:
    def spoil(specs: list[ProcessSpec]) -> list[ProcessSpec]:
        return [replace(spec, index=999) if spec.name == "g3" else spec for spec in specs]

    outcome = supervised(plan_of("paper", SHORT), tmp_path, order=spoil)
    assert outcome.failure is not None
    assert outcome.failure.startswith("lost leader g3 (exit code 1)")
    assert "IndexError" in outcome.failure


def test_a_stopped_process_is_named_and_the_run_given_up(tmp_path: Path) -> None:
    folder, notes = tmp_path, []
    stopped: list[int] = []

    def watch(progress: Progress) -> None:
        if progress.time_ns and not stopped:
            stopped.append(pid_of("g2/r5", descendants(os.getpid())))
            os.kill(stopped[0], signal.SIGSTOP)
        if progress.note and progress.note not in notes:
            notes.append(progress.note)

    outcome = supervised(plan_of("paper", "duration=1000"), folder, show=watch, stall_timeout_s=5.0)
    assert any("everyone waits for g2/r5" in note and "stopped" in note for note in notes), notes
    assert outcome.failure is not None
    until_s = outcome.trace.common()[0][-1] / 1e9
    assert outcome.failure.startswith(f"stalled for 5 s at t = {until_s:g} s: ")
    assert not Path(f"/proc/{stopped[0]}").exists()


@pytest.mark.parametrize("name", ["recorder", "g1"])
def test_a_process_that_stands_still_for_a_while_costs_only_time(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("echelon.sim.processes.stalls.STALL_REPORT_S", 2.2)
    plan, notes = plan_of("paper", "duration=3", LINKS), []
    stopped: list[int] = []

    def watch(progress: Progress) -> None:
        if progress.time_ns and not stopped:
            stopped.append(pid_of(name, descendants(os.getpid())))
            os.kill(stopped[0], signal.SIGSTOP)
        if progress.note and progress.note not in notes:
            notes.append(progress.note)
            if f"for {name}" in progress.note and "stopped" in progress.note:
                os.kill(stopped[0], signal.SIGCONT)

    outcome = supervised(plan, tmp_path, show=watch, can_urls=("virtual",))
    assert outcome.failure is None, notes
    assert any(f"for {name}" in note for note in notes)
    assert outcome.trace.digest() == trace_of(plan).digest()
    assert outcome.can.frames == 9 * 3000


def test_signals_wait_while_the_folder_of_the_fork_server_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    masks: list[set[int]] = []
    make = util.get_temp_dir

    def noted() -> str:
        masks.append({*signal.pthread_sigmask(signal.SIG_BLOCK, ())})
        return make()

    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    monkeypatch.setattr(util, "get_temp_dir", noted)
    warm_up(plan_of("lab"))
    assert masks
    assert all(mask >= {signal.SIGINT, signal.SIGTERM, signal.SIGHUP} for mask in masks)
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def test_a_recorder_that_stands_still_when_the_run_breaks_off_keeps_what_has_come_to_it(tmp_path: Path) -> None:
    plan = plan_of("lab", "duration=1000")
    hit: list[str] = []

    def watch(progress: Progress) -> None:
        if progress.time_ns > 500_000_000 and not hit:
            hit.append("recorder")
            os.kill(pid_of("recorder", descendants(os.getpid())), signal.SIGSTOP)
        elif len(hit) == 1:  # the next time: members have gone on meanwhile
            hit.append("g2/r5")
            os.kill(pid_of("g2/r5", descendants(os.getpid())), signal.SIGKILL)

    outcome = Supervisor(plan, tmp_path, run="kept", virtual=True, can_urls=("virtual",), show=watch).run()
    assert outcome.failure is not None
    assert "lost robot g2/r5" in outcome.failure
    shown = Counter(frame.frame.can_id for frame in frames_in(tmp_path / "can.log"))
    recorded = [len(times) for times in read_trace(tmp_path / "run.mcap", plan).times_ns]
    for robot in plan.robots:  # the bridge makes a frame of each state
        assert recorded[robot.index] >= shown[BASE_ID + robot.index] > 50


def test_a_recorder_that_stands_still_at_the_end_is_named_and_keeps_what_has_come_to_it(tmp_path: Path) -> None:
    plan = plan_of("lab", "duration=3.0")
    stopped_ns: list[int] = []

    def watch(progress: Progress) -> None:
        if progress.time_ns and not stopped_ns:
            os.kill(pid_of("recorder", descendants(os.getpid())), signal.SIGSTOP)
            stopped_ns.append(progress.time_ns)

    outcome = Supervisor(plan, tmp_path, run="kept", virtual=False, show=watch).run()
    assert outcome.failure == "lost recorder (does not answer, stopped)"
    last_ns = [times[-1] for times in read_trace(tmp_path / "run.mcap", plan).times_ns]
    assert min(last_ns) > stopped_ns[0] + 300_000_000  # what others have sent meanwhile waits in its sockets


def test_ctrl_c_during_start_up_ends_without_a_traceback(tmp_path: Path) -> None:
    options = ("--set", "duration=1000", "--can", "none", "--quiet", "--no-report", "--out", tmp_path / "run")
    command = start_echelon("run", "paper", *options)
    try:
        assert until(lambda: len(session_members(command.pid)) > 2)  # the fork server is just importing
        os.killpg(command.pid, signal.SIGINT)
        code, out, err = finished(command)
    finally:
        kill_session(command.pid)
    assert code in (3, -signal.SIGINT)  # the latter if an import was interrupted: Python tells its caller so
    assert err.splitlines()[-1] == "echelon: interrupted"
    assert "Traceback" not in out + err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_keeps_what_it_recorded(long_run: tuple[Popen[str], Path], number: int) -> None:
    command, folder = long_run
    os.kill(command.pid, number)
    code, _, err = finished(command)
    assert code == 3
    assert "interrupted" in err
    trace = read_trace(folder / "run.mcap", plan_of("paper", "duration=1000"))
    assert trace.digest() == summary_of(folder)["trace_digest"]


def test_ctrl_c_in_a_terminal_reaches_everyone_and_ends_well(long_run: tuple[Popen[str], Path]) -> None:
    command, folder = long_run
    os.killpg(command.pid, signal.SIGINT)
    code, _, err = finished(command)
    assert code == 3
    assert "interrupted" in err
    assert "Traceback" not in err
    assert summary_of(folder)["instants"] > 10


def test_nothing_outlives_a_killed_supervisor(long_run: tuple[Popen[str], Path], tmp_path: Path) -> None:
    command, folder = long_run
    assert len(session_members(command.pid)) >= 16
    os.kill(command.pid, signal.SIGKILL)
    command.wait()
    assert until(lambda: not session_members(command.pid)), session_members(command.pid)
    result = recover(folder / "run.mcap", tmp_path / "mended.mcap")
    assert result.messages > 1000


def test_full_disk_ends_the_run_and_says_so(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, hard))  # inherited by all processes of the run
    try:
        command = start_echelon(
            *("run", "paper", "--set", "duration=1000", "--can", "none", "--no-report", "--quiet"),
            *("--out", tmp_path / "run"),
        )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    code, _, err = finished(command)
    assert code == 3
    assert "the recording failed" in err
    assert recover(tmp_path / "run" / "run.mcap", tmp_path / "mended.mcap").messages > 1000


def test_a_note_names_a_dozen_processes_at_most() -> None:
    names = [f"r{number}" for number in range(127)]
    assert few(names[:3]) == "r0, r1, r2"
    assert few(names[:NAMED]) == ", ".join(names[:12])
    assert few(names, "; ") == "; ".join([*names[:12], "and 115 more"])


def test_a_run_of_many_that_stalls_says_so_in_a_short_line(tmp_path: Path) -> None:
    """Twenty robots stop, and their leader waits for all of them."""
    robots = ", ".join(f"r{number} = {{ start = [{number}.0, 0.0] }}" for number in range(20))
    text = TWENTY.format(robots=robots)
    plan = parse(text, "t.toml")[1]
    notes: list[str] = []

    def watch(progress: Progress) -> None:
        if progress.note:
            notes.append(progress.note)
        elif progress.messages > 200:
            for pid in stoppable():
                os.kill(pid, signal.SIGSTOP)

    def stoppable() -> list[int]:
        named = {pid: Path(f"/proc/{pid}/comm").read_text().strip() for pid in descendants(os.getpid())}
        return [pid for pid, name in named.items() if re.fullmatch(r"r\d+", name)]

    outcome = supervised(plan, tmp_path, show=watch, stall_timeout_s=5.0)
    (note,) = {note for note in notes if note.startswith("stalled")}
    assert note.count("(process ") == NAMED
    assert note.endswith(", and 8 more")
    assert outcome.failure is not None
    assert len(outcome.failure.splitlines()[0]) < 800
