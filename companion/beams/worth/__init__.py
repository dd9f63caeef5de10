"""What beams are worth: guaranteed gain, patterns, channels, link budget."""
