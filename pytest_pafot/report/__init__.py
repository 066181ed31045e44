"""Texts, pages and pictures for people. This room renders values and decides nothing."""
