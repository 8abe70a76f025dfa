"""Who may speak in a run: the secret of each process, whom it lets in, whom it connects to, and what each of them may say.

A process proves to the one that it connects to that it knows its password (Zenoh's authentication by user and password; the
password itself is not sent).  The other direction needs no password: a process takes messages only from the identifier, drawn
at random, of the process that it was told to connect to.  Each process lets each other one publish its own keys only; what
comes under other keys is dropped before it is stored or decoded (Zenoh's access control).
"""

import os
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

SAYS: Final = ("put", "delete", "reply", "liveliness_token")
"""Kinds of Zenoh messages that publish something under a key"""
HEARS: Final = (
    "declare_subscriber",
    "declare_queryable",
    "query",
    "liveliness_query",
    "declare_liveliness_subscriber",
)
"""Kinds of Zenoh messages that ask for what others publish"""


@dataclass(frozen=True, slots=True)
class Identity:
    """A process of a run as others know it."""

    user: str
    """Its name, which no other process of the run has"""
    zenoh_id: str
    """The random identifier of its session, 32 hexadecimal digits"""
    password: str = field(repr=False)
    keys: tuple[str, ...]
    """The key expressions that it may publish under"""


@dataclass(frozen=True, slots=True)
class Credentials:
    """What a process needs to know of itself and of those that it is connected to."""

    own: Identity
    realm: tuple[str, ...] = ("**",)
    """Key expressions that cover all keys of the run; the others may hear what is published under these"""
    guests: tuple[Identity, ...] = ()
    """Those that connect to it"""
    hosts: tuple[Identity, ...] = ()
    """Those that it connects to"""

    @contextmanager
    def settings(self) -> Iterator[dict[str, Any]]:
        """A context with the settings of Zenoh; they are valid while the session is opened."""
        lines = "".join(f"{guest.user}:{guest.password}\n" for guest in self.guests)
        passwords = os.memfd_create("passwords", os.MFD_CLOEXEC)  # Zenoh reads a file; this one has no name
        try:
            os.write(passwords, lines.encode())
            yield {
                "id": self.own.zenoh_id,
                "transport/auth/usrpwd/user": self.own.user,
                "transport/auth/usrpwd/password": self.own.password,
                "transport/auth/usrpwd/dictionary_file": f"/proc/self/fd/{passwords}",
                "access_control": self._access(),
            }
        finally:
            os.close(passwords)

    def _access(self) -> dict[str, Any]:
        """Returns the access control: each of the others may say what its keys are, and hear everything."""
        others = [("usernames", guest.user, guest.keys) for guest in self.guests]
        others += [("zids", host.zenoh_id, host.keys) for host in self.hosts]
        everywhere = {"permission": "allow", "key_exprs": list(self.realm)}
        rules: list[dict[str, Any]] = [
            {"id": "hears", "flows": ["ingress"], "messages": list(HEARS), **everywhere},
            {"id": "is told", "flows": ["egress"], "messages": [*SAYS, *HEARS], **everywhere},
        ]
        subjects, policies = [], []
        for number, (kind, who, keys) in enumerate(others):
            subject, rule = f"subject {number}", f"says {number}"
            subjects.append({"id": subject, kind: [who]})
            allowed = ["hears", "is told"]
            if keys:
                rules.append(
                    {
                        "id": rule,
                        "permission": "allow",
                        "flows": ["ingress"],
                        "messages": list(SAYS),
                        "key_exprs": list(keys),
                    }
                )
                allowed.append(rule)
            policies.append({"rules": allowed, "subjects": [subject]})
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        }


def new_identity(user: str, keys: Sequence[str]) -> Identity:
    """Returns a new identity with random secrets.  Raises ValueError for a name that cannot stand in Zenoh's list."""
    if not user or set(user) & set(":\n"):
        raise ValueError(f"user {user!r}: expected a name without ':' and without line breaks")
    # Zenoh takes no identifier that begins with a zero.
    zenoh_id = secrets.choice("123456789abcdef") + secrets.token_hex(16)[1:]
    return Identity(user, zenoh_id, secrets.token_urlsafe(32), tuple(keys))
