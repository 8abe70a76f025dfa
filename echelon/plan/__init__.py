"""The plan of a run: frozen data for all roles, made once from a scenario (echelon.planning.plan_maker)."""
