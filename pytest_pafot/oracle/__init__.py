"""A run as the user's test function sees it, and what that says of it."""
