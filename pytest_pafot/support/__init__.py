"""What every room may need, and what knows nothing of scenarios."""
