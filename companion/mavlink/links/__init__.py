"""UDP, TCP and serial endpoints over which MAVLink comes and goes.                       [shell]"""
