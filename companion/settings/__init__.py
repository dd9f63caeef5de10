"""The settings: sections with units, defaults and ranges, read from TOML and flags."""
