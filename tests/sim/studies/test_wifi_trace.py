"""The shipped trace of a wireless network is what its documented model makes, on every machine."""

import runpy
from math import isclose

from echelon.messages import Channel
from echelon.shipped import FOLDER
from support.runs import ROOT, plan_of


def test_the_shipped_trace_is_that_of_its_model() -> None:
    model = runpy.run_path(str(ROOT / "examples" / "wifi_trace.py"))
    delays = model["delays"]()
    assert (FOLDER / "wifi.csv").read_text(encoding="utf-8") == model["text"](delays)
    there = sorted(delay for delay in delays if delay is not None)
    assert isclose(there[len(there) // 2], 0.0019, abs_tol=2e-4)
    assert 0.004 < 1 - len(there) / len(delays) < 0.02
    plan = plan_of("lab", 'links=[{channel="state", delay={kind="trace", file="wifi.csv"}}]')
    link = next(link for link in plan.links if link.channel is Channel.STATE)
    assert link.delays is not None
    assert len(link.delays.delays_ns) == len(delays)
