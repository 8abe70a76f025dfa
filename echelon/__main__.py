"""`python -m echelon`: the same as the command `echelon`."""

import sys

# `-m` puts the working folder first in sys.path: a user's numpy.py there would be imported in place of numpy.
if not sys.flags.safe_path:
    del sys.path[0]

from echelon.cli import main

sys.exit(main())
