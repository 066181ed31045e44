"""Scenarios and the records of their runs: values that check themselves."""
