"""The search algorithms and the catalogue of their names."""
