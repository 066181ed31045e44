"""What is not needed by everybody; the core opens it by :mod:`pytest_pafot.door`, when it is asked for."""
