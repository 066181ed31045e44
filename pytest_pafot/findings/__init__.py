"""Findings: identity of failures, replays, severity and shrinking."""
