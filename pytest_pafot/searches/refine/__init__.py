"""The work on findings after a search's runs: shrinking, confirmation and examination."""
