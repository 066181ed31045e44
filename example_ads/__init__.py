"""Driving policies to search: careful ones, intentionally flawed ones, and published ones behind adapters.

Each module has a factory ``make()`` that returns a fresh ADS (or, for highway-env's own drivers, the vehicle class).
An installed pytest-pafot provides them as ``pytest_pafot.example_ads``.
"""
