"""Drivers and vehicles: kinds of ADS and what they see, highway-env's vehicles, and directors, which steer the NPCs."""
