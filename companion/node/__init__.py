"""The running node: live service, replay, demo, and what keeps them going.               [shell]"""
