"""Study of the report rate that a UAV needs."""
