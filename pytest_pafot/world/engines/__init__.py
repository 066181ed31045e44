"""Runs of scenarios: of every kind of ego by one loop, and by ``env.step``, mostly as a check."""
