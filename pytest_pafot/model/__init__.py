"""Scenarios and the records of their runs."""
