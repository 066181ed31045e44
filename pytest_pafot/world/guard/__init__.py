"""The user's code under guard: a limit on the time of a decision, and what is recorded of one that fails."""
