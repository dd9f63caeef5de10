"""Beams applied to hardware: the loop, where beams come from, and a file for each device."""
