"""Whole runs: in one process or in many, and what they leave: recording, summary, report, tables."""
