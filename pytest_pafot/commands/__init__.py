"""The commands ``search``, ``replay``, ``corpus`` and ``rate``."""
