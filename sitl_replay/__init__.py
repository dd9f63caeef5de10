"""Test traffic: synthetic vehicles and logs, sent as live MAVLink.

``flight`` contains the scenarios, as pure functions of time: ``motion``, ``paths``, ``attitudes``
and ``wind`` model how vehicles move, ``relay`` what ADS-B receivers receive; ``flights`` and
``fleet`` define the vehicles, ``scenario`` the scenarios; ``payloads`` encodes the messages, and
``vehicles`` schedules the MAVLink 2 frames. ``faults`` (also pure) injects faults into the
traffic. ``traffic`` sends and receives; ``cli`` is the command ``sitl-replay``.
"""
