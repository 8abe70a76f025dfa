"""What tells the fates of a link's messages, from its plan to its record."""

from typing import Any

from echelon.plan.delay_tables import DelayTable, DelayTrace, factors
from echelon.plan.link_plan import LinkPlan
from echelon.runtime.fates import normal_table
from echelon.sim.batch import records as r
from echelon.sim.batch.pools import Pools


def fates_of(link: LinkPlan, pools: Pools) -> dict[str, Any]:
    """Returns the numbers of a link's fates and clocks (echelon.runtime.fates)."""
    found: dict[str, Any] = {
        "fixed": link.delay_min_ns == link.delay_max_ns and not link.delays and not link.loss and not link.duplicates,
        "kind": r.DRAWN,
        "delay_min_ns": link.delay_min_ns,
        "delay_span_ns": link.delay_max_ns - link.delay_min_ns,
        "windows_at": pools.index([instant for window in link.blackouts for instant in window]),
        "windows": len(link.blackouts),
        "loss_of_message": link.loss_of_message,
        "fifo": link.fifo,
        "loss": link.loss,
        "duplicates": link.duplicates,
        "source_offset_ns": link.source_clock.offset_ns,
        "source_drift": link.source_clock.drift,
        "receiver_offset_ns": link.receiver_clock.offset_ns,
        "receiver_drift": link.receiver_clock.drift,
    }
    if (bursts := link.bursts) is not None:
        found |= {name: getattr(bursts, name) for name in ("to_bad", "to_good", "share_bad", "loss_good", "loss_bad")}
        found["bursts"] = True
    match link.delays:
        case DelayTable(correlation=correlation):
            found |= {"kind": r.TABLE_Z if correlation else r.TABLE, "table_at": pools.shared(link.delays.delays_ns)}
            if correlation:
                found["normal_at"] = pools.shared(tuple(normal_table().tolist()))
                found["rho"], found["rest"] = factors(correlation)
        case DelayTrace(times_ns=times_ns):
            found |= {"kind": r.BY_TIME if times_ns else r.BY_NUMBER, "table_at": pools.shared(link.delays.delays_ns)}
            found |= {"table_size": len(link.delays.delays_ns), "times_at": pools.shared(times_ns)}
    return found
