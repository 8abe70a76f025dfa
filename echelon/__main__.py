"""`python -m echelon`: the same as the command `echelon`."""

import sys

# `-m` puts the working folder first among the places of modules: a user's numpy.py there would be taken for numpy.
if not sys.flags.safe_path:
    del sys.path[0]

from echelon.cli import main

sys.exit(main())
