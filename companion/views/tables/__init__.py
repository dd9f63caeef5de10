"""Tables of an export, one module per subject: columns with unit, meaning and value.

``docs/export.md`` is generated from these tables.
"""
