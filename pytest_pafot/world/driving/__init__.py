"""Kinds of ADS, what they see, and the drivers and vehicles that need highway-env's code; others are in the kernel."""
