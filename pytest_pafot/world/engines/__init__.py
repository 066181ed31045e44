"""Engines that run scenarios: one loop for all kinds of egos, and ``env.step``, which also confirms findings."""
