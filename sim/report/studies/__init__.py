"""Figures of studies: from the tables of a sweep to pictures.

A figure is a pure function from `results.StudyResults`, the tables and what was predicted about them, to a `Picture`.
`figures.study_figures` chooses those that a study's tables can fill.
"""
