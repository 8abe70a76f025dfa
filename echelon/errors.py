"""Errors for mistakes of a user, and a collector that reports several mistakes in one error."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

SHOWN_LINES: Final = 20
"""How many lines of an error are shown; of further lines only the number is shown."""


class UserError(Exception):
    """A mistake of the user.  The command line prints it without a traceback and exits with code 2.

    Each argument is a line; usually there is one.  The text names the value and what is allowed.  Characters that are not
    printable are escaped, so a line stays one line even if a file holds line breaks in odd places."""

    def __init__(self, *lines: str) -> None:
        self.lines = tuple(one_line(line) for line in lines)
        super().__init__(*self.lines)

    def __str__(self) -> str:
        more = [f"and {len(self.lines) - SHOWN_LINES} more"] if len(self.lines) > SHOWN_LINES else []
        return "\n  ".join([*self.lines[:SHOWN_LINES], *more])


class UsageError(UserError):
    """Arguments of a command that contradict each other, or that need something this machine does not have."""


class PartRunError(UserError):
    """A part from outside this package failed in a run.  The text is one line: the part's file and class, and the failure.

    The command line exits with code 3, not 2, since the run had begun."""


class Mistakes:
    """Collects the mistakes of steps that do not depend on each other, so that one error reports them all."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Context of one step: a UserError in it ends the step and is collected; the code after the step goes on."""
        try:
            yield
        except UserError as error:
            self.lines += error.lines

    def check(self, kind: type[UserError]) -> None:
        """Raises one error of type `kind` with all collected lines, each text once.  Does nothing if there are none."""
        if self.lines:
            raise kind(*dict.fromkeys(self.lines))


def one_line(text: str) -> str:
    """Returns a text with its unprintable characters (among them line breaks) escaped, so that it is one line."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
