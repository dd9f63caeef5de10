"""Which frames and reports are used: signatures, allow lists, duplicates, ADS-B relays."""
