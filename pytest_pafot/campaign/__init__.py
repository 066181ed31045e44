"""One search, from its replays to its findings."""
