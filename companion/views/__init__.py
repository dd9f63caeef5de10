"""The program's state as the API and the commands show it: degrees, metres, null for unknown."""
