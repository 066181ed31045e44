"""Saved scenarios as files: the only room that knows yaml."""
