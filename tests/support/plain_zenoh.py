"""Zenoh's own sessions, for tests of what others may do with a secret: nothing in them checks or holds back anything."""

import json
from collections.abc import Sequence

import zenoh

from echelon.runtime.credentials import Identity


def plain_session(endpoints: Sequence[str], who: Identity) -> zenoh.Session:
    """Returns a session that connects to endpoints with the name and the password of `who`."""
    config = zenoh.Config()
    settings: dict[str, object] = {
        "mode": "peer",
        "connect/endpoints": list(endpoints),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 5, "period_max_ms": 20, "period_increase_factor": 2},
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/auth/usrpwd/user": who.user,
        "transport/auth/usrpwd/password": who.password,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)
