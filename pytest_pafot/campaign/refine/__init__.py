"""What happens to a finding after the search."""
