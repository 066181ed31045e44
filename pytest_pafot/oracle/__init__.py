"""The run that a test function receives."""
