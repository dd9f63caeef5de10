"""Location-aware beamforming from MAVLink: bytes in, array weights out.

The rooms, in the order in which data flows: ``mavlink`` (bytes to reports), ``tracking``
(reports to tracks), ``beams`` (tracks to weights); ``pipeline`` folds them into one function of
events, and ``service``, ``recording`` and ``server`` are the shell around it.
"""

__version__ = "0.1.0"
