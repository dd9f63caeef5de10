"""Logs in other formats, converted to the MAVLink that their vehicle would have sent.

``kinds`` detects files by their first bytes. ``dataflash`` and ``ulog`` parse an autopilot's
onboard log into columns; ``ardupilot``, ``receiver`` and ``px4`` interpret the columns;
``csv_table`` reads tables. ``onboard`` contains the samples of one vehicle in any format, and
``said`` converts them to frames. ``gps_time`` maps a boot clock to GPS time, and ``together``
several logs to one timeline. ``packets`` and ``capture`` extract MAVLink from its packets.
"""
