"""Texts and pages for people. This package renders values and decides nothing."""
