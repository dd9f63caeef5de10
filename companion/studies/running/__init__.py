"""Work on many cores or a cluster, and optional packages.                                [shell]"""
