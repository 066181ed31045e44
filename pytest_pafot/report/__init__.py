"""Texts, pages and pictures for people. This package renders values and decides nothing."""
