"""Predictors compared on logs."""
