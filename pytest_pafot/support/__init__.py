"""Tools that every room may need. They know nothing about scenarios."""
