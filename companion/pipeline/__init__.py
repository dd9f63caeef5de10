"""The fold that turns frames into tracks and beams, and its assembly from the settings."""
