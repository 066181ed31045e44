"""Responsibility for a collision."""
