"""Recordings: what is written while running, and every kind of log that can be read back.

``schemas`` is what a recording's messages look like, ``writer`` writes them, ``container`` walks
an MCAP file as far as it is intact, ``recover`` finishes one that was cut short; ``tlog`` and
``timeline`` deal with the logs of other programs; ``reader`` is the one door to all of them.
"""
