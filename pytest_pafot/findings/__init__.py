"""Findings: what a failing run means, what makes two the same, and the files in which they are kept."""
