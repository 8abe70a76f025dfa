"""Virtual drives in lockstep: at the end their watchdogs expire, and whoever listens hears of it."""

from contextlib import closing

from echelon.bridge.stations.lockstep_drives import LONGEST_REST_NS, LockstepDrives
from support.runs import plan_of


def test_what_drives_say_at_the_end_is_bounded_however_long_their_watchdogs_are() -> None:
    plan = plan_of("lab", "can.path=closed", "claims=[]", "can.watchdog=1000.0")
    with closing(LockstepDrives(plan, ["virtual:at-the-end"])) as drives:
        drives.stop()
        sent = drives._buses[0].counts.sent
    each = sum(LONGEST_REST_NS // robot.drive.period_ns for robot in plan.robots)
    assert 0 < sent <= 2 * each
