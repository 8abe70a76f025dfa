"""The command `echelon`.  It may import every other folder of the package; no other folder imports it.

`parser` has the list of commands.  The commands are defined in `run`, `scenario`, `results`, `bus` and `machine`.  These
modules are cheap to import, so that `--help` answers at once; a command imports what it works with only when it is called.
"""

import os
import sys
from collections.abc import Sequence

os.environ.setdefault(
    "OPENBLAS_NUM_THREADS", "1"
)  # before numpy is imported: for small matrices its threads only cost time

from echelon.cli.output import Output, patient_output
from echelon.errors import PartRunError, UserError, one_line

DEBUG = "ECHELON_DEBUG"
"""Environment variable: set to 1, it does the same as the option `--debug`."""
NOBODY_READS = 141
"""Exit code of a command that prints until it is stopped, when its reader has ended; as of programs that SIGPIPE ends"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command with these arguments, by default those of the process; returns its exit code.

    code  meaning
    0     done, and the verdict does not fail
    1     done, and the verdict fails
    2     a mistake of the user
    3     it could not be done, or not to its end, or not be printed
    141   nobody reads any more what it prints until it is stopped

    An error is one line on standard error.  Ends the process for `--help` and for wrong arguments, as argparse does."""
    with patient_output() as output:
        return _main(arguments, output)


def _main(arguments: Sequence[str] | None, output: Output | None) -> int:
    debug = os.environ.get(DEBUG, "") not in ("", "0")
    try:
        from echelon.cli.parser import read

        call = read(arguments)
        debug = debug or call.debug
        if output is not None:
            output.live = call.live
        code = call.work()
        print(end="", flush=True)  # here, so that an error of it is known below
        if output is not None and output.trouble is not None and not isinstance(output.trouble, BrokenPipeError):
            print(f"echelon: standard output: {output.trouble.strerror}", file=sys.stderr)
            return code or 3
        return code
    except UserError as error:
        if debug and error.__cause__ is not None:  # the exception that a user's part raised
            import traceback

            traceback.print_exception(error.__cause__)
        print(f"echelon: {error}", file=sys.stderr)
        return 3 if isinstance(error, PartRunError) else 2
    except BrokenPipeError:
        return NOBODY_READS
    except KeyboardInterrupt:
        # Where the interrupt came out of an `exec`, as of a dataclass that is made, Python would end the process by SIGINT
        # whatever is returned here.  The next `exec` makes it forget that.
        exec("")
        print("echelon: interrupted", file=sys.stderr)
        return 3
    except Exception as error:
        if debug:
            import traceback

            traceback.print_exc()
        else:
            print(_error_line(error), file=sys.stderr)
        return 3


def _error_line(error: Exception) -> str:
    """Returns one line about an unexpected error: what it is, where it was raised, and how to see the traceback."""
    import traceback

    place = traceback.extract_tb(error.__traceback__)[-1]
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    more = f"--debug or {DEBUG}=1 shows the traceback"
    return one_line(f"echelon: {what} ({place.filename}:{place.lineno}; {more})")
