"""How scenarios are run: in this process, in lock step, in other processes."""
