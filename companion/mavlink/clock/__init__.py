"""Senders' boot clocks on the node's timeline: stamps, round trips, reboots."""
