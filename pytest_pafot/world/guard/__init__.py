"""Protection against failures in the user's code."""
