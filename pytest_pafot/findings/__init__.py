"""Findings as values: identity of failures, replays, severity and shrinking. No files."""
