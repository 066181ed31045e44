"""Runs of findings as files for other tools; each format is a module that is imported when it is asked for."""
