"""Recordings: written while running, and read back together with every other kind of log.

``schemas`` describes a recording's messages, ``writer`` writes them, ``container`` walks an MCAP
file as far as it is intact, and ``recover`` finishes a file that was cut short. ``tlog`` and
``stamps`` handle the logs of other programs; ``reader`` opens all of them.
"""
