"""Engines that run scenarios: one loop for all kinds of egos, and ``env.step``, which confirms findings."""
