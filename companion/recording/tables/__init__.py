"""Tables for other programs: what a column is, CSV and Parquet, and the folder of an export.

``companion.views.tables`` says which tables there are and what stands in each column.
"""
