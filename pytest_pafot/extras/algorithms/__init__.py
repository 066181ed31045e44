"""The search algorithm that only comparisons need."""
