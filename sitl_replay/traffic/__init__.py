"""Sends scenarios and logs as live traffic, and records traffic."""
