"""Traffic to test against: synthetic vehicles and logs as live MAVLink.

``flight`` has the scenarios, as pure functions of time: ``motion``, ``paths``, ``attitudes`` and
``wind`` say how vehicles move, ``relay`` what ADS-B receivers hear, ``flights`` and ``fleet`` which
vehicles there are, ``scenario`` the scenarios themselves; ``payloads``, with ``geodesy``, makes
what a vehicle sends, and ``vehicles`` the schedule of MAVLink 2 frames. ``faults`` makes the
traffic faulty, purely as well. ``traffic`` is the shell that sends and receives; ``cli`` is the
command ``sitl-replay``.
"""
