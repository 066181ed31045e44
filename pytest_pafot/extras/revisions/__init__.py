"""Policies of other commits: as a reference of a search, and the command ``bisect``."""
