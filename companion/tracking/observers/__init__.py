"""The observers: one on the position model, one on the kinematic model."""
