"""Performance of an array's beams over a recorded flight."""
