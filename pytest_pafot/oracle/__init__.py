"""The run that a test function receives, and the checks that it makes."""
