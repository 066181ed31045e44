"""Policies, their perception, and the drivers and vehicles that need highway-env's code."""
