"""True positions of vehicles, recovered from logs."""
