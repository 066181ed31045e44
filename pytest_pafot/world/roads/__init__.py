"""Straight roads, paths through networks of lanes, and junctions."""
