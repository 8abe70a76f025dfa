"""Observing a run that goes on: the secret of those who may read it and never write, and what they hear.

A run with `--observe` has a process `observers` that receives copies of all messages and gives them on.  It never waits for an
observer: one that is slow or stands still misses messages, and the run goes on.
"""

import json
import os
import threading
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Final, Self

from echelon.bridge.frame_message import FrameBounds
from echelon.errors import UsageError
from echelon.files import read_json
from echelon.messages import Message
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan
from echelon.runtime.admission import ALWAYS, Refusals
from echelon.runtime.admission_rules import admissions_of
from echelon.runtime.credentials import Credentials, Identity, new_identity
from echelon.runtime.session import Session, loopback_endpoints
from echelon.runtime.wire import SCHEMA_VERSION, data_key, run_keys, token_key

TICKET: Final = "observe.json"
HIGH_WATER: Final = 16384
"""How many messages an observer may be behind before it misses the oldest ones"""
CONNECT_S: Final = 5.0
"""How long an observer tries to reach a run [s]"""


@dataclass(frozen=True, slots=True)
class Ticket:
    """What an observer needs to know of a run."""

    run: str
    """The run's name in the keys of its messages"""
    schema_version: int
    endpoint: str
    """Where the process `observers` listens"""
    zenoh_id: str
    """The identifier of its session"""
    user: str
    password: str

    def write(self, folder: Path) -> None:
        """Writes the ticket into the folder of a run, readable by this user only.  Raises OSError."""
        path = folder / TICKET
        path.unlink(missing_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Reads the ticket in the folder of a run.  Raises UsageError if there is none, or it cannot be used."""
        try:
            ticket = cls(**read_json((folder / TICKET).read_bytes()))
            texts = [one.name for one in fields(cls) if one.name != "schema_version"]
            if wrong := [name for name in texts if not isinstance(getattr(ticket, name), str)]:
                raise ValueError(f"{', '.join(wrong)}: must be text")
        except FileNotFoundError:
            raise UsageError(
                f"{folder}: holds no {TICKET}; `echelon run … --observe` opens a run for observers"
            ) from None
        except (OSError, ValueError, TypeError) as error:
            raise UsageError(f"{folder / TICKET}: cannot be read: {error}") from None
        if ticket.schema_version != SCHEMA_VERSION:
            what = f"speaks schema version {ticket.schema_version}, not {SCHEMA_VERSION}"
            raise UsageError(f"{folder}: the run {what}; observe it with the version of echelon that runs it")
        return ticket


@dataclass(frozen=True, slots=True)
class Gate:
    """Where the process `observers` lets observers in, and its credentials there."""

    endpoint: str
    credentials: Credentials
    ticket: Ticket


def new_gate(run: str) -> Gate:
    """Returns a gate for a run, with new secrets.  Observers may publish nothing."""
    own, guest = new_identity("observers", ()), new_identity("observer", ())
    (endpoint,) = loopback_endpoints(1)
    ticket = Ticket(run, SCHEMA_VERSION, endpoint, own.zenoh_id, guest.user, guest.password)
    return Gate(endpoint, Credentials(own, run_keys(run), guests=(guest,)), ticket)


def gate_token(run: str) -> str:
    """Returns the key of the token that the process `observers` shows to observers."""
    return token_key(run, "observers", "gate", "gate")


def observe(ticket: Ticket, plan: Plan, under: str = "", refusals: Refusals | None = None) -> Iterator[Message]:
    """Yields the messages of a run of a plan until it ends: of the member with the path `under` and of all below it.

    What is no message of the plan is counted in `refusals` and left out.  Raises UsageError if the run cannot be reached."""
    guest = Identity(ticket.user, new_identity(ticket.user, ()).zenoh_id, ticket.password, ())
    host = Identity("observers", ticket.zenoh_id, "", run_keys(ticket.run))
    ended = threading.Event()
    paths = [one.path for one in plan.all_roles]
    counts = Refusals() if refusals is None else refusals
    admissions = admissions_of(plan, range(len(paths)), counts, virtual=False, frames=FrameBounds(plan))
    with Session(
        listen=[],
        connect=[ticket.endpoint],
        lockstep=False,
        credentials=Credentials(guest, run_keys(ticket.run), hosts=(host,)),
    ) as session:
        doors = {
            data_key(ticket.run, paths[each.source], each.channel): partial(each.admit, now_ns=NEVER_NS)
            for each in admissions
            if not under or f"{paths[each.source]}/".startswith(f"{under}/")
        }
        inbox = session.checked_inbox(doors, HIGH_WATER)
        token = gate_token(ticket.run)
        if session.watch_tokens(token, lambda key: ended.set()).wait([token], CONNECT_S):
            raise UsageError(f"the run {ticket.run} does not answer at {ticket.endpoint}; is it over?")
        over = False
        while not over:
            over = ended.is_set()
            for message in inbox.take(0.2):
                if message.values.size or message.channel not in ALWAYS:
                    yield message
