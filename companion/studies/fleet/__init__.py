"""Simulation of many nodes and UAVs in one process: cost and handovers of a fleet."""
