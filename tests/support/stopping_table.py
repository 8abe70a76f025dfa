"""What comes of each hit to a process of a run, as a table: `kill -9`, signals, standing still × both clocks."""

import signal
from typing import Final, NamedTuple

from echelon.sim.processes.stalls import BREAK_S
from support.stopped import WATCHDOG_S

AT_ONCE: Final = 0.5
"""Some processes hear of it, one after the other, and some frames go over the bus [s]"""
WATCHDOG: Final = WATCHDOG_S + AT_ONCE
STALL_S: Final = 4.0
"""Stall timeout of the runs in which somebody stands still for ever in virtual time: after the first warning [s]"""
WAITING_S: Final = 1.5
"""After so long members have said that they wait, and the supervisor has looked [s]"""


class Out(NamedTuple):
    """What comes of a hit."""

    zero_s: float | None = None
    """After so long no wheel has torque, and none is commanded; None: nobody stops the wheels"""
    code: int | None = None
    """Exit code of the run; None: it goes on"""
    said: str = ""
    """What the run says about {who}; "" if it says nothing"""
    silent: bool = False
    """True: nobody sends a frame until the process goes on"""


ASKED: Final = Out(AT_ONCE, 3, "{who} was asked to end (SIG{signal})")
INTERRUPTED: Final = Out(AT_ONCE, 3, "echelon: interrupted")
LOST: Final = Out(AT_ONCE, 3, "lost {who} (killed by SIGKILL)")
GONE: Final = Out(AT_ONCE, -signal.SIGKILL)
ON: Final = Out()
NAMED: Final = Out(said="{who} stands still, for ")
ZERO: Final = NAMED._replace(zero_s=WATCHDOG)
BREAKS: Final = NAMED._replace(zero_s=max(WATCHDOG_S, BREAK_S) + 2 * AT_ONCE, code=3)
WAITS: Final = Out(silent=True)
AWAITED: Final = Out(said="everyone waits for {name} ", silent=True)
STALLS: Final = Out(STALL_S + WAITING_S + 2 * AT_ONCE, 3, "everyone waits for {name} ")
AHEAD: Final = AWAITED._replace(silent=False)
"""Members run ahead of a watcher"""
NO_ROW: Final = None

HITS: Final = ("KILL", "TERM", "HUP", "INT", "STOP 0.2", "STOP 2", "STOP 20", "STOP")
"""`STOP 2`: stands still for 2 s; `STOP`: for ever"""
SIGNALS: Final = (ASKED, ASKED, NO_ROW)
TABLE: Final[dict[str, dict[str, tuple[Out | None, ...]]]] = {
    "wall": {
        # 0.2 s is below the watchdog: the drives go on with the last torque, as they do in any period
        "supervisor": (GONE, INTERRUPTED, INTERRUPTED, INTERRUPTED, ON, ON, ON, ON),
        "team/solo": (LOST, *SIGNALS, ON, ZERO, ZERO, ZERO),
        "team": (LOST, *SIGNALS, ON, ZERO, ZERO, ZERO),
        "coordinator": (LOST, *SIGNALS, ON, ZERO, ZERO, ZERO),
        "bridge": (LOST._replace(zero_s=WATCHDOG), ASKED, ASKED, ASKED, ON, BREAKS, BREAKS, BREAKS),
        "drives": (LOST, *SIGNALS, ON, BREAKS, BREAKS, BREAKS),
        "recorder": (LOST, *SIGNALS, ON, NAMED, NAMED, NAMED),
        "referee": (LOST, *SIGNALS, ON, NAMED, NAMED, NAMED),
        "observers": (LOST, *SIGNALS, ON, NAMED, NAMED, NAMED),
        "all": (NO_ROW, INTERRUPTED, INTERRUPTED, INTERRUPTED),
        "all twice": (NO_ROW, INTERRUPTED, INTERRUPTED, INTERRUPTED),
    },
    "virtual": {
        # all wait for who stands still, and so does the time of the wheels
        "supervisor": (GONE, INTERRUPTED, INTERRUPTED, INTERRUPTED, ON, ON, ON, ON),
        "team/solo": (LOST, *SIGNALS, ON, WAITS, AWAITED, STALLS),
        "team": (LOST, *SIGNALS, ON, WAITS, AWAITED, STALLS),
        "coordinator": (LOST, *SIGNALS, ON, WAITS, AWAITED, STALLS),
        "bridge": (LOST, ASKED, ASKED, ASKED, ON, WAITS, AWAITED, STALLS),
        "drives": (LOST, *SIGNALS, ON, WAITS, AWAITED, STALLS),
        "recorder": (LOST, *SIGNALS, ON, ON, AHEAD, STALLS),
        "observers": (LOST, *SIGNALS, ON, ON, AHEAD, STALLS),
        "all": (NO_ROW, INTERRUPTED, INTERRUPTED, INTERRUPTED),
        "all twice": (NO_ROW, INTERRUPTED, INTERRUPTED, INTERRUPTED),
    },
    "mirrored, wall": {
        # no drives on the bus report; what counts is what the bridge commands
        "bridge": (LOST, ASKED, ASKED, NO_ROW, ON, NAMED._replace(silent=True), NO_ROW, NAMED._replace(silent=True)),
    },
    "mirrored, virtual": {
        "bridge": (LOST, ASKED, ASKED, NO_ROW, ON, WAITS, AWAITED, STALLS),
    },
}
KINDS: Final = {"team/solo": "robot team/solo", "team": "leader team"}
