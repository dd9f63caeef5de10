"""Array weights: zero forcing and its relatives, wide beams and nulls, grouping of users."""
