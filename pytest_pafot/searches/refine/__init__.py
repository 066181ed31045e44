"""The work on findings after a search: shrinking, confirmation and examination."""
