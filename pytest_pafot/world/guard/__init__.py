"""Protection against failures of the user's code."""
