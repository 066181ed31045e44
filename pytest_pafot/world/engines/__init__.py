"""Runs of scenarios: by one loop for every kind of ego, or by ``env.step``, which confirms findings."""
