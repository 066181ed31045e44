"""Findings as values: what a failing run means, what makes two the same, what a replay says, and how one is shrunk."""
