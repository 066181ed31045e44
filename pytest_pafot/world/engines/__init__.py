"""Runs of scenarios: of every kind of ego by one loop, many in lock step, and by ``env.step``, mostly as a check."""
