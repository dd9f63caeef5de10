"""Logs in the words of others, as the MAVLink that their vehicle would have sent.

``kinds`` tells files by their first bytes. ``dataflash`` and ``ulog`` walk the bytes of an
autopilot's own log and give columns; ``ardupilot``, ``receiver`` and ``px4`` say what the columns
mean; ``csv_table`` reads tables. ``onboard`` holds the samples of one vehicle, whatever wrote them,
and ``said`` makes frames of them. ``gps_time`` puts a boot clock on GPS time, and ``together``
several logs on one timeline. ``packets`` and ``capture`` take MAVLink out of what is around it.
"""
