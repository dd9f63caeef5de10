"""Live operation of a node in a fleet, over Zenoh."""
