"""The commands ``search`` and ``bisect``, and what several commands share: names of policies and resumable tasks."""
