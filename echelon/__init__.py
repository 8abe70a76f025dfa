"""echelon: groups of wheeled robots in formation, every robot its own process, wheel torques on a CAN bus.

This package is the vocabulary that every process shares: the scenario and the plan made from it, messages and their
bytes, links, roles and their mailboxes, the Zenoh session, and the command line.
"""

import os

__version__ = "0.1.0"

# A formation's matrices are small, and its processes many: threads of numpy's would only wait for each other.  It reads
# this once, when it is loaded, so it must be said before.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
