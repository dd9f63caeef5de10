"""Acceptance of frames and reports: signatures, allow lists, duplicates, ADS-B relays."""
