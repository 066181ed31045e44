"""Runs of findings as files for other tools. Each format is a module that is imported only when it is requested."""
