"""The running node: live service, replay, demo, and their surroundings."""
