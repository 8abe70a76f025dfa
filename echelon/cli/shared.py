"""Options and help texts that several commands share."""

from dataclasses import dataclass, field
from typing import Final

from echelon.cli.options import argument, option

SCENARIO: Final = (
    "a TOML file, the name of a shipped scenario (paper, lab, …), the folder of a run, or - for standard input"
)
OVERRIDES: Final = option(
    "change a value of the scenario: law.epsilon=[0.1,0.2], links.0.delay=0.05; may be repeated",
    "KEY=VALUE",
    flag="--set",
)
JSON: Final = option("print JSON, for scripts")


def seconds(text: str) -> float:
    """Returns the duration [s] in a text.  Raises ValueError if it is not a number more than 0 and less than 1e9."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise ValueError(f"{text!r} is no duration in seconds: must be a number more than 0")
    return value


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioOptions:
    """Options of a command that reads a scenario."""

    scenario: str = field(metadata=argument(SCENARIO, "SCENARIO"))
    overrides: tuple[str, ...] = field(default=(), metadata=OVERRIDES)
