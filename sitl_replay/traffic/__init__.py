"""Sending of scenarios and logs as live traffic, and recording of traffic."""
