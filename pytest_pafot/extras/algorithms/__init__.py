"""The search algorithms that only comparisons need."""
