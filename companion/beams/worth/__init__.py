"""Performance of beams: guaranteed gain, patterns, channels, link budget."""
