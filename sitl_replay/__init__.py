"""Traffic to test against: synthetic vehicles and logs as live MAVLink.

``scenario`` says who flies where, ``vehicles`` turns that into a schedule of MAVLink 2 frames
(both pure: time is an argument); ``player``, ``recorder`` and ``links`` are the shell that sends
and receives them; ``cli`` is the command ``sitl-replay``.
"""
