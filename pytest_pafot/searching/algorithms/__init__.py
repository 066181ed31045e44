"""The algorithms of the search, each in one file, and the catalogue of their names."""
