"""Assembles whole runs: the in-process engine, processes under supervision, recording, summary, report, export."""
