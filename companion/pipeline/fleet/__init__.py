"""A fleet of nodes: what they share, whose clock is whose, who serves whom, who is not believed."""
