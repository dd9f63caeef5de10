"""This node's place in a fleet, over Zenoh."""
