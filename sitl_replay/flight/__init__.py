"""Scenarios: paths and messages of vehicles, as pure functions of time."""
