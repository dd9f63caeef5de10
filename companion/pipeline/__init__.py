"""The fold that turns frames into tracks and beams, and its construction from the settings."""
