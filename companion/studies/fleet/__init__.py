"""Many nodes and UAVs in one process and virtual time: what a fleet costs, how it hands over."""
