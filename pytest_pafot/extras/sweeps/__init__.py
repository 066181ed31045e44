"""Scenarios that are asked for: a catalogue of named ones, and maps of what becomes of them as two numbers change."""
