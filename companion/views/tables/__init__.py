"""The tables of an export, a module a subject: every column with its unit, meaning and value.

``docs/export.md`` says the same in words, and a test holds it against these.
"""
