"""Traffic to test against: synthetic vehicles and logs as live MAVLink.

Pure, time is an argument: ``motion``, ``paths``, ``attitudes`` and ``wind`` say how vehicles
move, ``relay`` what ADS-B receivers hear, ``flights`` and ``fleet`` which vehicles there are;
``scenario`` has the scenarios; ``payloads``, with ``geodesy``, says what a vehicle sends, and
``vehicles`` makes the schedule of MAVLink 2 frames. ``player``, ``recorder`` and ``links`` are the
shell that sends and receives them; ``cli`` is the command ``sitl-replay``.
"""
