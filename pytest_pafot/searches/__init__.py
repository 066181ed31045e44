"""One search, from the replays of saved scenarios to new findings."""
