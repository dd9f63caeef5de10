"""The published experiments repeated, and the method's claims judged."""
