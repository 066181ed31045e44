"""Drivers and vehicles: kinds of ADS, their sight, highway-env's vehicles, and directors of NPCs."""
