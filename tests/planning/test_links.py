"""Rules of links and events of links: what they make of a plan, and what is refused, in one line each."""

from pathlib import Path

import numpy as np
import pytest

from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.delay_tables import LOST, Bursts, ClockPlan, DelayTable, DelayTrace
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError, effective_toml
from echelon.sim.parts.loading import load, parse
from support.runs import SCENARIOS

LAB = SCENARIOS / "lab.toml"
FILES = {
    "good.txt": "\ufeff# measured\n0.010\n\nlost\n0.0205  # late\n",
    "times.csv": "time,delay\n-1, 0.1\n0.5; 0.2\n2,lost\n",
    "headless.csv": "0,0.1\n1,0.2\n",
    "columns.csv": "seq, Delay\n7,0.1\n8,0.2\n",
    "all_lost.txt": "lost\nlost\n",
    "negative.txt": "0.1\n-0.2\n",
    "words.txt": "# a\n0.1\nx y\n",
    "empty.txt": "\n# a\n",
    "head.txt": "delay\n",
    "back.csv": "time,delay\n0,0.1\n1,0.2\n1,0.1\n",
    "other.csv": "a,b\n0,1\n",
    "no_time.csv": "time,delay\n0,0.1\nlost,0.2\n",
    "late_time.csv": "0,0.1\n1e7,0.2\n",
    "infinite.txt": "0.1\ninf\n",
    "ragged.csv": "0,0.1\n0.2\n",
    "long.txt": "1e7\n",
    "empty_cell.csv": "0,0.1\n1,\n",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scenario lab and files of traces."""
    folder = tmp_path_factory.mktemp("traces")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    (folder / "binary.txt").write_bytes(b"0.1\n\xff\n")
    (folder / "lab.toml").write_text(LAB.read_text())
    return folder


def plan_of(folder: Path, *overrides: str) -> Plan:
    return load(folder / "lab.toml", overrides)[1]


def states(plan: Plan) -> LinkPlan:
    """Returns the first link of states."""
    return next(link for link in plan.links if link.channel is Channel.STATE)


@pytest.mark.parametrize(
    ("delay", "expected"),
    [
        ("{kind='trace',file='good.txt'}", DelayTrace((10_000_000, LOST, 20_500_000))),
        ("{kind='trace',file='columns.csv'}", DelayTrace((100_000_000, 200_000_000))),
        ("{kind='trace',file='all_lost.txt'}", DelayTrace((LOST, LOST))),
        ("{kind='trace',file='headless.csv'}", DelayTrace((100_000_000, 200_000_000))),
        (
            "{kind='trace',file='times.csv',by='time'}",
            DelayTrace((100_000_000, 200_000_000, LOST), (-1_000_000_000, 500_000_000, 2_000_000_000)),
        ),
    ],
)
def test_traces(folder: Path, delay: str, expected: DelayTrace) -> None:
    link = states(plan_of(folder, f"links=[{{channel='state',delay={delay}}}]"))
    assert link.delays == expected
    come = [each for each in expected.delays_ns if each != LOST]
    limits_ns = (min(come), max(come)) if come else (0, 0)
    assert (link.delay_min_ns, link.delay_max_ns) == limits_ns
    assert not link.ideal
    assert not link.steady


@pytest.mark.parametrize(
    ("delay", "line"),
    [
        (
            "{file='negative.txt'}",
            ".file = 'negative.txt': line 2: delay -0.2 must be a number from 0 to 1e+06, or 'lost'",
        ),
        ("{file='words.txt'}", ".file = 'words.txt': line 3: 'x y' must be a number, or 'lost'"),
        ("{file='empty.txt'}", ".file = 'empty.txt': holds no delay"),
        ("{file='head.txt'}", ".file = 'head.txt': holds no delay"),
        ("{file='infinite.txt'}", ".file = 'infinite.txt': line 2: inf must be a finite number"),
        ("{file='long.txt'}", ".file = 'long.txt': line 1: delay 1e7 must be a number from 0 to 1e+06"),
        ("{file='other.csv'}", ".file = 'other.csv': its columns are a, b; one must be called delay"),
        ("{file='ragged.csv'}", ".file = 'ragged.csv': line 2 has 1 values, not 2"),
        ("{file='empty_cell.csv'}", ".file = 'empty_cell.csv': line 2: '' must be a number, or 'lost'"),
        (
            "{file='back.csv',by='time'}",
            ".file = 'back.csv': line 4: time 1 must be later than that of the line before",
        ),
        ("{file='no_time.csv',by='time'}", ".file = 'no_time.csv': line 3: 'lost' must be a number\n"),
        (
            "{file='late_time.csv',by='time'}",
            ".file = 'late_time.csv': line 2: time 1e7 must be a number from -1e+06 to 1e+06",
        ),
        ("{file='good.txt',by='time'}", ".file = 'good.txt': by = 'time' needs a column called time"),
        ("{file='none.txt'}", ".file: FOLDER/none.txt: No such file or directory"),
        ("{file='.'}", ".file: FOLDER: Is a directory"),
        ("{file='binary.txt'}", ".file: FOLDER/binary.txt: is not UTF-8 text"),
        ("{file=3}", ".file: must be the name of a file, relative to the scenario"),
        ("{by='time'}", ".file: missing"),
        ("{file='good.txt',by='line'}", ".by = 'line': must be one of 'message', 'time'"),
    ],
)
def test_mistakes_in_traces_name_their_line(folder: Path, delay: str, line: str) -> None:
    delay = delay.replace("{", "{kind='trace',")
    with pytest.raises(ScenarioError) as caught:
        plan_of(folder, f"links=[{{delay={delay}}}]")
    (said,) = caught.value.lines
    assert f": links.0.delay{line.replace('FOLDER', str(folder))}" in f"{said}\n"  # a line break stands for the end


@pytest.mark.parametrize(
    ("rule", "line"),
    [
        (
            "delay={kind='nrmal',mean=1}",
            ".delay.kind = 'nrmal': must be one of 'uniform', 'normal', 'gamma', 'pareto', 'trace'",
        ),
        ("delay={kind=3}", ".delay.kind = 3: must be one of 'uniform'"),
        ("delay={kind='normal',mean=1}", ".delay.std: missing"),
        ("delay={kind='normal',mean=1,std=0}", ".delay.std = 0: must be greater than 0"),
        (
            "delay={kind='normal',mean=-1,std=0.01}",
            ".delay: min = 0.0 cuts off nearly everything; must be at most mean + 8 std",
        ),
        ("delay={kind='normal',mean=0,std=1,min=2e6}", ".delay.min = 2000000.0: must be at most 1e+06"),
        ("delay={kind='gamma',shape=0.01,scale=0.1}", ".delay.shape = 0.01: must be at least 0.1"),
        ("delay={kind='gamma',shape=2,scale=-1}", ".delay.scale = -1: must be greater than 0"),
        ("delay={kind='pareto',shape=2,min=0}", ".delay.min = 0: must be greater than 0"),
        ("delay={min=0,max=1,correlation=1.0}", ".delay.correlation = 1.0: must be less than 1"),
        ("delay={min=0,max=1,correlation=-0.5}", ".delay.correlation = -0.5: must be at least 0"),
        (
            "loss={mean=0.9,burst=2}",
            ".loss: burst = 2.0: with so short bursts the mean loss cannot be 0.9; must be at least 9",
        ),
        ("loss={mean=0.5,burst=0.5}", ".loss.burst = 0.5: must be at least 1"),
        ("loss={mean=1.0,burst=5}", ".loss.mean = 1.0: must be less than 1"),
        ("loss={mean=0.5,burst=3,bad=0.4}", ".loss: mean = 0.5 must be at least good = 0.0 and less than bad = 0.4"),
        ("loss={mean=0.1,burst=3,good=0.2}", ".loss: mean = 0.1 must be at least good = 0.2 and less than bad = 1.0"),
        ("loss={mean=0.5}", ".loss.burst: missing"),
        ("loss=[1]", ".loss = [1]: must be a number or a table"),
        ("loss_of='all'", ".loss_of = 'all': must be one of 'receiver', 'message'"),
        ("order='fito'", ".order = 'fito': must be one of 'any', 'fifo'; did you mean 'fifo'?"),
        ("duplicates=2", ".duplicates = 2: must be at most 1"),
        (
            "policy='zero'",
            ".policy = 'zero': is for the channels 'command' and 'reference', and the rule fits 'state' too",
        ),
        (
            "policy='zero',channel='command',delay={kind='gamma',shape=1,scale=0.1}",
            ".timeout: missing; policy = 'zero' needs it",
        ),
        ("policy='hold',timeout=1", ": timeout = 1.0: policy = 'hold' has none; leave it out"),
        ("name='Up'", ".name = 'Up': a name is a lower-case letter"),
    ],
)
def test_mistakes_in_rules(folder: Path, rule: str, line: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        plan_of(folder, f"links=[{{{rule}}}]")
    (said,) = caught.value.lines
    assert f": links.0{line}" in said


def test_names_of_rules_are_used_in_overrides_and_in_errors(folder: Path) -> None:
    rules = "links=[{name='uplink',channel='state'},{name='down',channel='command',loss=0.1}]"
    plan = plan_of(folder, rules, "links.uplink.delay=0.05", "links.down.loss=0.2")
    assert {(link.name, link.delay_max_ns, link.loss) for link in plan.links if link.name} == {
        ("uplink", 50_000_000, 0.0),
        ("down", 0, 0.2),
    }
    for override, line in [
        ("links.uplink.delay=-1", "links.uplink.delay = -1: must be at least 0"),
        ("links.down.delay=2e6", "links.down.delay = 2000000.0: must be at most 1e+06"),
        ("links.down.dealy=1", "links.down.dealy: unknown key; did you mean 'delay'?"),
        ("links.uplink.source=g9", "links.uplink.source = 'g9': fits no member"),
        (
            "links.up.delay=1",
            "links has 2 entries; give its number or its name ('uplink', 'down'): links.0.up.delay or",
        ),
        ("links.1.name=uplink", "links.uplink.name = 'uplink': is the name of another rule"),
    ]:
        with pytest.raises(ScenarioError) as caught:
            plan_of(folder, rules, override)
        assert f"with --set {override}: {line}" in caught.value.lines[0]
    with pytest.raises(ScenarioError, match=r"name = 'delay': is the name of a key"):
        plan_of(folder, "links=[{name='delay'}]")


@pytest.mark.parametrize(
    ("event", "line"),
    [
        ("kind='blackout',at=1,duration=-1", ".duration = -1: must be greater than 0"),
        ("kind='blackout',at=-1", ".at = -1: must be at least 0"),
        ("kind='blackout',at=1,link='x'", ".link = 'x': must be one of 'uplink'"),
        ("kind='blackout',at=1,link='uplink',channel='command'", ": no link of the rule 'uplink' goes from '**'"),
        ("kind='blackout',at=1,source='x'", ".source = 'x': fits no member; there are coordinator"),
        ("kind='blackout',at=1,source='g1',receiver='g2'", ": no link goes from 'g1' to 'g2' on channel '*'"),
        ("kind='cut_off',at=1,member='x'", ".member = 'x': fits no member; there are coordinator"),
        ("kind='cut_off',at=1", ".member: missing"),
        ("kind='cutoff',at=1", ".kind = 'cutoff': must be one of 'drive_fault'"),
    ],
)  # fmt: skip
def test_mistakes_in_events(folder: Path, event: str, line: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        plan_of(folder, "links=[{name='uplink',channel='state'}]", f"events=[{{{event}}}]")
    assert f": events.0{line}" in caught.value.lines[0]


def test_blackouts_and_cut_off_members(folder: Path) -> None:
    plan = plan_of(
        folder,
        "links=[{name='uplink',channel='state',source='g1/*'}]",
        "events=[{kind='blackout',at=1,duration=2,link='uplink'},{kind='cut_off',at=2.5,duration=1,member='g1/r1'},"
        "{kind='cut_off',at=9,member='coordinator'},{kind='blackout',at=5,duration=0.5,channel='command',receiver='g2/*'}]",
    )
    names = [one.name for one in plan.formation]
    second = 10**9
    for link in plan.links:
        source, receiver = names[link.source], names[link.receiver]
        expected: list[tuple[int, int]] = []
        if link.channel is Channel.STATE and source.startswith("g1/"):
            expected = [(second, 7 * second // 2 if source == "g1/r1" else 3 * second)]
        elif receiver == "g1/r1":
            expected = [(5 * second // 2, 7 * second // 2)]
        elif "coordinator" in (source, receiver):
            expected = [(9 * second, NEVER_NS)]
        elif link.channel is Channel.COMMAND and receiver.startswith("g2/"):
            expected = [(5 * second, 11 * second // 2)]
        assert link.blackouts == tuple(expected)
        assert link.ideal == (not expected)
    assert plan.events == ()


@pytest.mark.parametrize(
    ("loss", "mean", "expected"),
    [
        ("{mean=0.2,burst=4}", 0.2, Bursts(0.0625, 0.25, 0.0, 1.0)),
        ("{mean=0.5,burst=1}", 0.5, Bursts(1.0, 1.0, 0.0, 1.0)),
        ("{mean=0.3,burst=2,good=0.1,bad=0.6}", 0.3, Bursts(1 / 3, 0.5, 0.1, 0.6)),
        ("{mean=0.0,burst=2}", 0.0, Bursts(0.0, 0.5, 0.0, 1.0)),
    ],
)
def test_bursts(folder: Path, loss: str, mean: float, expected: Bursts) -> None:
    link = states(plan_of(folder, f"links=[{{channel='state',loss={loss}}}]"))
    assert link.bursts is not None
    assert link.loss == mean
    for name in ("to_bad", "to_good", "loss_good", "loss_bad"):
        assert getattr(link.bursts, name) == pytest.approx(getattr(expected, name), rel=1e-12)
    shares = link.bursts.share_bad, 1 - link.bursts.share_bad
    assert shares[0] * link.bursts.loss_bad + shares[1] * link.bursts.loss_good == pytest.approx(mean)


def test_timeouts_of_policies(folder: Path) -> None:
    plan = plan_of(
        folder,
        "links=[{policy='hold'},{channel='command',policy='zero',delay={min=0,max=0.015}},"
        "{channel='reference',policy='hold_then_stop',timeout=0.3}]",
    )
    expected = {Channel.COMMAND: ("zero", 24_999_999), Channel.REFERENCE: ("hold_then_stop", 300_000_000)}
    for link in plan.links:
        assert (link.policy, link.timeout_ns) == expected.get(link.channel, ("hold", NEVER_NS))


def test_clocks_are_inherited_and_stand_on_the_links(folder: Path) -> None:
    plan = plan_of(
        folder,
        "robot.clock.offset=0.002",
        "formation.groups.g1.robot.clock.drift=1e-5",
        "formation.groups.g1.robots.r1.clock.offset=-0.5",
        "formation.groups.g2.clock.offset=1.0",
        "formation.clock.drift=-2e-5",
    )
    clocks = {one.name: one.clock for one in plan.formation}
    assert clocks["g1/r1"] == ClockPlan(-500_000_000, 1e-5)
    assert clocks["g1/r2"] == ClockPlan(2_000_000, 1e-5)
    assert clocks["g2/r4"] == ClockPlan(2_000_000, 0.0)
    assert (clocks["g1"], clocks["g2"], clocks["coordinator"]) == (ClockPlan(), ClockPlan(10**9), ClockPlan(0, -2e-5))
    names = list(clocks)
    for link in plan.links:
        assert (link.source_clock, link.receiver_clock) == (clocks[names[link.source]], clocks[names[link.receiver]])
    assert ClockPlan(5, 1e-5).reading_ns(2_000_000) == 2_000_025
    link = next(link for link in plan.links if names[link.source] == "g1/r1")
    assert link.read_age_ns(3 * 10**9, 2 * 10**9) == 10**9 + 500_000_000 - 20_000


def test_links_are_written_out_whole(folder: Path) -> None:
    """The effective scenario, with files under new names, makes the same links."""
    scenario, plan = load(
        folder / "lab.toml",
        [
            "links=[{name='uplink',channel='state',delay={kind='gamma',shape=2,scale=0.01,correlation=0.5},loss={mean=0.1,burst=4}},"
            "{channel='command',delay={kind='trace',file='times.csv',by='time'},order='fifo',loss_of='message',duplicates=0.1},"
            "{channel='group_state',delay={min=0.0,max=0.1}},{channel='reference',delay={kind='pareto',min=0.01,shape=2}}]",
            "events=[{kind='blackout',at=1,link='uplink'},{kind='cut_off',at=1,duration=1,member='g1'}]",
        ],
    )
    assert isinstance(states(plan).delays, DelayTable)
    written = effective_toml(scenario, {scenario.links[1].delay.file: "headless.csv"})  # type: ignore[union-attr]
    assert "headless.csv" in written
    assert parse(effective_toml(scenario), "again", folder=folder)[1].links == plan.links


def test_tables_ascend_from_the_smallest_delay_for_every_shape(folder: Path) -> None:
    for delay in (
        "{kind='gamma',shape=0.1,scale=10}",
        "{kind='gamma',shape=10000,scale=1e-5,min=0.5}",
        "{kind='pareto',shape=0.1,min=0.001}",
        "{kind='pareto',shape=10000,min=0.001}",
        "{kind='normal',mean=-0.1,std=0.02}",
        "{kind='normal',mean=1,std=1e-6,correlation=0.9}",
        "{min=0.1,max=0.1,correlation=0.9}",
    ):
        link = states(plan_of(folder, f"links=[{{channel='state',delay={delay}}}]"))
        assert isinstance(link.delays, DelayTable)
        table = np.array(link.delays.delays_ns)
        assert (np.diff(table) >= 0).all()
        assert (table[0], table[-1]) == (link.delay_min_ns, link.delay_max_ns)
        assert 0 <= table[0] <= table[-1] <= 10**15
