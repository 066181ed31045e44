"""The reports of a session, for users and programs."""
