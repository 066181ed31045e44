"""Findings, with their identity, severity, replays and shrinking."""
