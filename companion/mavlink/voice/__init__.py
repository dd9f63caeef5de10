"""What the service itself sends over MAVLink: its presence, and requests for message rates."""
