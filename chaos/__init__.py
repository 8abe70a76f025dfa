"""Chaos: runs that are killed, frozen, flooded, lied to and left without a disk, and a checker of what became of them.

`python -m chaos` draws plans from seeds (`plans`), carries each of them out on a run of the command line (`trial`), and lets
a checker judge what the run left behind (`checker`).  The run is a black box: its processes are found by their names, its
frames are heard by a socket of its own (`listener`), and its files are read here anew (`evidence`, `frames`).  Nothing in
this package imports the code that it judges.
"""
