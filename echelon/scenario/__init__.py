"""What a user writes: the tables of a scenario, as pydantic models."""
