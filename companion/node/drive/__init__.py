"""Beams applied to hardware: the loop, the sources of beams, and a module for each device."""
