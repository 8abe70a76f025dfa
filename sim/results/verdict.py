"""The verdict of a run: one word, and the checks that it stands on (docs/architecture.md, 6.5).

word      when                                                                    exit code of `echelon run`
HOLDS     the scenario has claims, all of them passed, and no check failed        0
HEALTHY   the scenario has no claims, and no check failed                         0
FAILS     a check failed, or a claim failed or was not tested                     1
"""

from dataclasses import dataclass
from typing import Final, Literal

Outcome = Literal["passed", "failed", "not tested"]
CLAIM: Final = "claim"
"""Name of the checks that are claims of the scenario"""
CAUSES: Final = ("whole", "finite")
"""Names of the checks that are reported first when they fail: often they are the reason why other checks fail"""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One check of a run, with its outcome."""

    name: str
    """`claim`, or one of the health checks of docs/scenario.md"""
    outcome: Outcome
    """`not tested`: the check applies to the run, but there was nothing to look at; or it is switched off"""
    text: str
    """The result in one sentence"""
    measured: float | None = None
    """The number that is compared with `bound`; None if there is no such number"""
    unit: str = ""
    """Unit of `measured` and `bound`; empty for a ratio or a share"""
    bound: float | None = None
    """The limit for `measured`; None if there is none"""
    about: tuple[str, ...] = ()
    """The blocks, robots or links that the result is about; empty: the whole run"""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict of a run.  HOLDS: the scenario has claims, all of them passed, and no check failed.  HEALTHY: the scenario
    has no claims, and no check failed.  FAILS: a check failed, or a claim failed or was not tested."""

    word: Literal["HOLDS", "HEALTHY", "FAILS"]
    """The verdict in a word"""
    checks: tuple[CheckResult, ...]
    """All checks: first the claims, then the health checks"""

    @property
    def fails(self) -> bool:
        """True if the word is FAILS."""
        return self.word == "FAILS"

    @property
    def claims(self) -> tuple[CheckResult, ...]:
        """The checks that are claims of the scenario."""
        return tuple(check for check in self.checks if check.name == CLAIM)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the run fails: the sentences of failed checks, those of `CAUSES` first, then of claims that were not tested."""
        failed = [check for check in self.checks if check.outcome == "failed"]
        failed.sort(key=lambda check: check.name not in CAUSES)
        untested = [check for check in self.checks if check.outcome == "not tested" and check.name == CLAIM]
        return tuple(f"{check.name}: {check.text}" for check in (*failed, *untested))

    @property
    def not_tested(self) -> tuple[str, ...]:
        """The sentences of health checks that were not tested."""
        return tuple(
            f"{check.name}: {check.text}"
            for check in self.checks
            if check.outcome == "not tested" and check.name != CLAIM
        )

    @property
    def sentence(self) -> str:
        """The word, with the number of claims and of checks by outcome."""
        claims, others = len(self.claims), [check.outcome for check in self.checks if check.name != CLAIM]
        passed = f"{count(others.count('passed'), 'check')} passed"
        passed += f", {len(self.not_tested)} not tested" if self.not_tested else ""
        match self.word:
            case "HOLDS":
                return f"HOLDS: {count(claims, 'claim')} and {passed}"
            case "HEALTHY":
                return f"HEALTHY: nothing was claimed; {passed}"
        failed = f"{count(len(self.reasons), 'reason')}; {passed}"
        return f"FAILS: {failed}" if claims else f"FAILS: nothing was claimed; {failed}"

    def __str__(self) -> str:
        return "\n".join([self.sentence, *self.reasons, *(f"not tested: {text}" for text in self.not_tested)])


def count(number: int, what: str) -> str:
    """Returns a number of things in words: `1 claim`, `3 claims`."""
    return f"{number} {what}{'s' * (number != 1)}"
