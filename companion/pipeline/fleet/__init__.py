"""Fleet of nodes: shared frames, clocks of other nodes, assignment of UAVs, trust."""
