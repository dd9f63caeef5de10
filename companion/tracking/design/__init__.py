"""Design of observer gains: closed form, linear matrix inequalities, and tables of gains."""
