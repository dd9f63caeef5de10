"""Observers on the position model and on the kinematic model."""
