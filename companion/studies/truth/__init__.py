"""True positions of vehicles, from what logs hold of them."""
