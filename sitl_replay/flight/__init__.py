"""Scenarios: who flies where and sends what, as pure functions of time."""
