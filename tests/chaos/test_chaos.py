"""`make chaos` in short: twenty plans, each with one hit on a small run, judged by the checker that shares no code with it."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from chaos import room
from chaos.__main__ import carry_out_apart, repeat
from chaos.plans import KINDS, TRAFFIC, ChaosPlan, draw
from support.vcan import vcan_required

pytestmark = pytest.mark.slow

PLANS = 20


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the folder of undisturbed runs."""
    return tmp_path_factory.mktemp("references")


def chosen() -> list[ChaosPlan]:
    """Returns the plans: of each kind of hit the first on each clock, and whatever comes until there are enough.

    Messages over Zenoh are forged with an observer's secret in virtual time, and without one on a wall clock."""
    secrets = {"virtual": "observer", "wall": "none"}
    drawn = [draw(seed, short=True) for seed in range(300)]
    plans = [plan for plan in drawn if plan.hits[0].kind != "forge_zenoh" or plan.hits[0].secret == secrets[plan.clock]]
    first = {(plan.hits[0].kind, plan.clock): plan for plan in reversed(plans)}
    others = [plan for plan in plans if plan not in first.values()]
    return sorted([*first.values(), *others][:PLANS], key=lambda plan: plan.seed)


def test_the_plans_are_of_all_kinds() -> None:
    assert {(plan.hits[0].kind, plan.clock) for plan in chosen()} == {
        (kind, clock) for kind in KINDS for clock in ("virtual", "wall")
    }
    assert {plan.path for plan in chosen()} == {"mirror", "closed"}
    assert {plan.hits[0].secret for plan in chosen() if plan.hits[0].kind == "forge_zenoh"} == {"none", "observer"}
    assert len(chosen()) == PLANS


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder for the plan.  Those of pytest are too deep for the sockets of a run, which would not begin."""
    with tempfile.TemporaryDirectory(prefix="chaos-") as name:
        yield Path(name)


@pytest.mark.parametrize("plan", chosen(), ids=str)
def test_a_run_keeps_its_promises_whatever_is_done_to_it(plan: ChaosPlan, folder: Path, references: Path) -> None:
    if plan.needs_room and (why := room.why_none()) is not None and plan.hits[0].kind in TRAFFIC:
        assert not vcan_required(), why
        pytest.skip(f"NOT TESTED: nothing can be sent from another host, no network namespace can be made here: {why}")
    again = f"{plan}\nagain: {repeat(plan, KINDS, True)}"
    for attempt in range(2):  # a run on a busy machine may be over before it is hit
        found = carry_out_apart(plan, folder / f"plan-{attempt}", references, KINDS, True)
        assert found.violations == [], again
        if found.carried_out:
            break
    assert (found.carried_out, found.missed) == (len(plan.hits), 0), again
