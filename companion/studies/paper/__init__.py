"""Reproduction of the published experiments and verdicts on the method's claims."""
