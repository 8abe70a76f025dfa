"""Chaos plans: a seed decides everything, and all kinds of hits come up."""

from chaos.plans import FOREVER, KINDS, TRAFFIC, draw, members


def test_the_same_seed_draws_the_same_plan() -> None:
    assert [draw(seed) for seed in range(200)] == [draw(seed) for seed in range(200)]
    assert len({str(draw(seed)) for seed in range(200)}) == 200


def test_five_hundred_plans_have_everything() -> None:
    plans = [draw(seed) for seed in range(500)]
    hits = [hit for plan in plans for hit in plan.hits]
    assert {hit.kind for hit in hits} == set(KINDS)
    assert {(plan.clock, plan.path) for plan in plans} == {
        (clock, path) for clock in ("virtual", "wall") for path in ("mirror", "closed")
    }
    assert {hit.lasts_s for hit in hits if hit.kind == "freeze"} == {0.2, 2.0, 20.0, FOREVER}
    assert {(hit.signal, hit.target) for hit in hits if hit.kind == "signal"} >= {
        (signal, target) for signal in ("TERM", "INT", "HUP") for target in ("bridge", "supervisor", "group")
    }
    bus = {(hit.kind, hit.origin) for hit in hits if hit.kind.endswith("_bus")}
    assert bus == {(kind, origin) for kind in TRAFFIC[:3] for origin in ("here", "elsewhere")}
    assert {hit.secret for hit in hits if hit.kind == "forge_zenoh"} == {"none", "observer"}
    assert any(hit.at_s < 0 for hit in hits)
    assert {len(plan.hits) for plan in plans} == {1, 2, 3}


def test_short_plans_are_hit_once_and_never_for_long() -> None:
    plans = [draw(seed, short=True) for seed in range(200)]
    assert all(len(plan.hits) == 1 and plan.hits[0].lasts_s <= 2.0 for plan in plans)


def test_targets_are_processes_of_the_run() -> None:
    for seed in range(300):
        plan = draw(seed)
        there = {*members(plan.path, plan.robots), "supervisor", "group", ""}
        assert {hit.target for hit in plan.hits} <= there


def test_only_the_kinds_that_were_asked_for() -> None:
    assert {hit.kind for seed in range(50) for hit in draw(seed, ("kill", "freeze")).hits} == {"kill", "freeze"}
