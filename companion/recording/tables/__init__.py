"""Tables for other programs: columns, CSV and Parquet, and the folder of an export.

``companion.views.tables`` defines the tables and their columns.
"""
