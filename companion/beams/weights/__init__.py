"""Array weights: zero forcing and related methods, wide beams and nulls, grouping of users."""
