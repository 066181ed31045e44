"""Who drives: kinds of ADS, the guard of their decisions, vehicles, drivers of NPCs."""
