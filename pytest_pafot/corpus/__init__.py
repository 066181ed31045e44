"""Saved scenarios as files; only this package imports yaml."""
