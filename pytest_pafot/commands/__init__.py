"""The commands ``search`` and ``bisect``, and what all commands share: how policies are named, and resumable work."""
