"""The style of figures, drawings as SVG, pages from templates, and how all are written."""
