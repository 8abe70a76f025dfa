"""Recordings of runs as MCAP files: writing, reading and recovering them.  Only this folder imports mcap."""
