"""Execution of scenarios: in this process, in lock step, in other processes, on other machines."""
