"""echelon: groups of wheeled robots in formation, every robot its own process, wheel torques on a CAN bus.

This package is the vocabulary that every process shares: the scenario and the plan made from it, messages and their
bytes, links, roles and their mailboxes, the Zenoh session, and the command line.
"""

__version__ = "0.1.0"
