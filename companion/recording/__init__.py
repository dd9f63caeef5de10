"""Recordings: written during a run, and read back together with every other kind of log.

``schemas`` describes a recording's messages, ``writer`` writes them, ``container`` parses an MCAP
file up to its damage, and ``recover`` completes a truncated file. ``tlog`` and ``stamps`` handle
the logs of other programs; ``reader`` opens all of them.
"""
