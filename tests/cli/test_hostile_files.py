"""Files of a run that are damaged, or made to do harm: one line, and no more memory or time than a whole run takes."""

import json
import random
import resource
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from echelon.cli import main
from support.runs import EXAMPLES, echelon, summary_of

SCENARIO = """\
name = "small"
duration = 0.5
robot = { mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }
law = { use = "my_laws.py:SlidingMode", epsilon = [0.5, 0.5] }
trajectory = { kind = "line", velocity = [0.3, 0.0] }
formation.groups.a.shape = { kind = "line", spacing = 1.0 }
formation.groups.a.robots = { a1 = { start = [0, 1.5] }, a2 = { start = [1, 1.5] } }
links = [{ source = "a/a1", delay = { kind = "trace", file = "late.csv" } }]
"""
COMMANDS = {
    "validate": ("validate", "RUN"),
    "report": ("report", "RUN", "--figures", "OUT"),
    "export": ("export", "RUN", "--csv", "OUT", "--replace"),
    "replay": ("replay", "RUN"),
    "diff": ("diff", "RUN", "WHOLE"),
    "latencies": ("latencies", "RUN", "--out", "OUT", "--replace"),
    "recover": ("recover", "RUN"),
    "referee": ("referee", "RUN"),
    "can": ("can", "RUN"),
}
MEMORY = 6 << 30
"""Address space of the tests [bytes]: what asks for more gets a MemoryError, which is a failure here"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on a wall clock, with a part of the user's and a trace of delays."""
    folder = tmp_path_factory.mktemp("hostile")
    (folder / "own.toml").write_text(SCENARIO)
    (folder / "late.csv").write_text("delay\n0.001\n0.002\nlost\n0.001\n")
    shutil.copy(EXAMPLES / "my_laws.py", folder)
    done = echelon("run", folder / "own.toml", "--clock", "wall", "--quiet", "--no-report", "--out", folder / "run")
    assert done.returncode in (0, 1), done.stderr
    return folder / "run"


def damaged(data: bytes, luck: random.Random) -> bytes:
    """Returns bytes with some changed, left out, doubled or cut off."""
    content = bytearray(data)
    for _ in range(luck.choice((1, 3, 20))):
        at = luck.randrange(len(content) or 1)
        match luck.randrange(5):
            case 0 if content:
                content[at] ^= 1 << luck.randrange(8)
            case 1:
                content[at : at + 4] = luck.choice((b"\xff" * 4, b"\0" * 4, b"9999", b"1e99", b"-inf", b"]]}}"))
            case 2:
                del content[at : at + luck.randrange(40)]
            case 3:
                content[at:at] = content[at : at + luck.randrange(60)]
            case _ if luck.random() < 0.2:
                del content[at:]
    return bytes(content)


def changed(value: Any, luck: random.Random) -> Any:
    """Returns values of JSON with one of them changed to another that is well-formed."""
    if isinstance(value, dict) and value and luck.random() < 0.95:
        key = luck.choice(sorted(value))
        if luck.random() < 0.05:
            return {name: each for name, each in value.items() if name != key}
        return value | {key: changed(value[key], luck)}
    if isinstance(value, list) and value and luck.random() < 0.9:
        at = luck.randrange(len(value))
        return [*value[:at], changed(value[at], luck), *value[at + 1 :]] if luck.random() < 0.8 else value[:at]
    others = (None, [], {}, "", "a\nb<script>", 0, -1, 0.5, 1e308, 10**30, True, [value] * 3)
    return luck.choice([other for other in others if luck.random() < 0.7 or isinstance(other, type(value))] or [0])


def run_all(names: tuple[str, ...], folder: Path, whole: Path, capfd: pytest.CaptureFixture[str], what: str) -> None:
    """Runs commands on a folder; each ends with a code of its own and at most a line of errors."""
    places = {"RUN": str(folder), "WHOLE": str(whole), "OUT": str(folder.parent / "out")}
    for name in names:
        code = main([places.get(word, word) for word in COMMANDS[name]])
        said = capfd.readouterr().err
        assert code in (0, 1, 2), (what, name, said)
        assert "Traceback" not in said, (what, name, said)
        assert code != 2 or name == "validate" or said.count("\n") <= 1 + said.count("\n  "), (what, name, said)


@pytest.fixture
def bounded() -> Any:
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.slow
@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize(
    ("file", "commands", "count"),
    [
        ("summary.json", ("export", "referee"), 12),
        ("run.mcap", ("diff", "replay", "latencies", "export", "recover"), 12),
        ("scenario.toml", ("validate", "diff", "replay", "latencies", "recover"), 12),
        ("arrivals.bin", ("replay", "latencies"), 20),
        ("can.log", ("referee", "can", "recover"), 12),
        ("run.json", ("can", "referee"), 12),
        ("late.csv", ("validate", "replay", "recover"), 12),
        ("my_laws.py", ("validate", "replay"), 6),
        (".echelon.json", ("recover",), 6),
    ],
)
def test_damage_is_one_line(
    file: str, commands: tuple[str, ...], count: int, whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    luck = random.Random(file)
    for number in range(count):
        folder = tmp_path / str(number)
        shutil.copytree(whole, folder)
        (folder / file).write_bytes(damaged((folder / file).read_bytes(), luck))
        run_all(commands, folder, whole, capfd, f"{file}, number {number}")
        shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.usefixtures("bounded")
def test_a_summary_with_other_values_is_one_line_or_read(
    whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    luck, folder = random.Random(1), tmp_path / "run"
    shutil.copytree(whole, folder)
    for number in range(8):
        (folder / "summary.json").write_text(json.dumps(changed(summary_of(whole), luck)))
        run_all(("report", "referee"), folder, whole, capfd, f"number {number}")


@pytest.mark.parametrize(
    "content",
    [lambda: b"", lambda: b"[" * 1_000_000, lambda: b'{"a":' * 100_000, lambda: b"\xff\xfe", lambda: b"0" * 10**7],
)
def test_a_summary_that_is_none_is_one_line(
    content: Callable[[], bytes], whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    (folder / "summary.json").write_bytes(content())
    assert main(["export", str(folder)]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert "summary.json" in said
    run_all(("referee", "can", "report"), folder, whole, capfd, "none")
