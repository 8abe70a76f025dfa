"""What roles need to know of a run: plain frozen data, made once from a scenario (echelon.planning.plan_maker)."""
