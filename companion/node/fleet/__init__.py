"""A live node of a fleet, over Zenoh."""
