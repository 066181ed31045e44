"""The commands ``search``, ``corpus`` and ``rate``, and what all commands share: how policies are named."""
