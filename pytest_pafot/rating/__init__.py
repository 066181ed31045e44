"""How often a policy crashes by itself: seeded episodes in an environment's own traffic, which no search has chosen."""
