"""Example policies to test: careful ones, intentionally flawed ones, and published ones with adapters.

Each module has a factory ``make()`` that returns a new ADS, or a vehicle class if the policy is a driver of
highway-env. The installed package contains these modules as ``pytest_pafot.example_ads``.
"""
