"""Whose fault a collision is, and what the ego nearly had to answer for."""
