"""What is raised for mistakes of a user, and how several of them are told at once."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

MOST: Final = 20
"""Lines of one error; what is more is counted."""


class UserError(Exception):
    """A mistake of the user's, one that the command line answers with exit code 2 and without a traceback.

    Each argument is a line; usually there is one.  The text names the value and what is allowed.  What is not printable
    in it is escaped, so that a line stays a line whatever was in a file."""

    def __init__(self, *lines: str) -> None:
        self.lines = tuple(one_line(line) for line in lines)
        super().__init__(*self.lines)

    def __str__(self) -> str:
        more = [f"and {len(self.lines) - MOST} more"] if len(self.lines) > MOST else []
        return "\n  ".join([*self.lines[:MOST], *more])


class UsageError(UserError):
    """Arguments of a command that do not go together, or that ask for what this machine does not have."""


class PartRunError(Exception):
    """A part that others wrote failed in a run; the text is one line that names its file and class, and what it did."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class Mistakes:
    """Collects the mistakes of steps that do not need one another."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Runs a step; notes its mistakes and goes on behind it."""
        try:
            yield
        except UserError as error:
            self.lines += error.lines

    def check(self, kind: type[UserError]) -> None:
        """Raises all that was noted as one error, each text once; nothing if nothing was."""
        if self.lines:
            raise kind(*dict.fromkeys(self.lines))


def one_line(text: str) -> str:
    """Returns a text with everything that is not printable escaped: one line, whatever was in the file."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
