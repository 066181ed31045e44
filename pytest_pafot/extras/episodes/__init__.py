"""Driving without a search: crash rates in an environment's own traffic, and comparisons of two policies."""
