"""Work on many cores or a cluster."""
