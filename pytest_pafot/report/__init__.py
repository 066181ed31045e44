"""Text for people. Renders values, decides nothing."""
