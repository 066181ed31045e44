"""Driving without a search: how often a policy crashes in an environment's own traffic, and episodes to train in."""
