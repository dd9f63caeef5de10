"""The pipeline, which turns frames into tracks and beams, and its construction."""
