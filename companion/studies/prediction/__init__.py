"""Comparison of predictors on logs."""
