"""The command `echelon`, at the top of the house: it imports what it needs, and nothing imports it.

`parser` knows all commands; each family of them has a file: `run`, `scenario`, `results`, `bus`, `machine`.  Those are
cheap to import, so that `--help` is there at once; a command imports what it works with when it is called.
"""

import os
import sys
from collections.abc import Sequence

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # numpy reads it when it is loaded: its threads would only wait

from echelon.errors import PartRunError, UserError, one_line

DEBUG = "ECHELON_DEBUG"
"""Set to 1 in the environment, it is as if `--debug` were given."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit code.

    0: done, and the verdict holds; 1: the verdict fails; 2: a mistake of the user's; 3: it could not be done."""
    debug = os.environ.get(DEBUG, "") not in ("", "0")
    try:
        from echelon.cli.parser import read

        call = read(arguments)
        debug = debug or call.debug
        code = call.work()
        print(end="", flush=True)  # while what goes wrong with it can still be told
        return code
    except UserError as error:
        if debug and error.__cause__ is not None:  # what a user's part raised
            import traceback

            traceback.print_exception(error.__cause__)
        print(f"echelon: {error}", file=sys.stderr)
        return 3 if isinstance(error, PartRunError) else 2
    except BrokenPipeError:  # a reader such as head that has seen enough
        _drop_output()
        return 0
    except KeyboardInterrupt:
        print("echelon: interrupted", file=sys.stderr)
        return 3
    except Exception as error:
        if debug:
            import traceback

            traceback.print_exc()
        else:
            print(_told(error), file=sys.stderr)
        try:
            print(end="", flush=True)
        except OSError:  # which was the error: the interpreter must not try once more when it ends
            _drop_output()
        return 3


def _drop_output() -> None:
    """Sends what is left of the output nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _told(error: Exception) -> str:
    """Returns what is said of an error that nobody expected: what, where, and how to see more, on one line."""
    import traceback

    place = traceback.extract_tb(error.__traceback__)[-1]
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    more = f"--debug or {DEBUG}=1 shows the traceback"
    return one_line(f"echelon: {what} ({place.filename}:{place.lineno}; {more})")
