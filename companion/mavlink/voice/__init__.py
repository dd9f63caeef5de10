"""MAVLink messages that the service itself sends: heartbeats, and requests for message rates."""
