"""Figure style, SVG drawings, page templates and their output."""
