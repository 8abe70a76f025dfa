"""The checker: what a run promises, held against the evidence.  It shares no code with what it checks."""

from collections.abc import Callable, Iterator
from typing import Final

from chaos import bus_rules, ending_rules
from chaos.evidence import Evidence
from chaos.verdict import Case, Violation

RULES: Final[tuple[Callable[[Case], Iterator[Violation]], ...]] = (
    bus_rules.no_late_torque,
    bus_rules.last_word,
    bus_rules.obeyed_nobody_else,
    ending_rules.states_are_the_undisturbed_ones,
    ending_rules.no_false_pass,
    bus_rules.nothing_made_up_for,
    bus_rules.log_is_the_wire,
    ending_rules.recording_is_kept,
    ending_rules.outside_ends_nothing,
    ending_rules.culprit_is_named,
    ending_rules.ends,
    ending_rules.code_is_the_verdict,
    ending_rules.nothing_left,
)
"""The most serious first"""


def check(evidence: Evidence) -> list[Violation]:
    """Returns what a run did not keep of its promises, the most serious first."""
    case = Case(evidence)
    return [violation for rule in RULES for violation in rule(case)]
