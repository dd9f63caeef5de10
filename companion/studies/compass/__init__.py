"""What the array's own measurements say of the carrier's attitude, on logs with truth."""
