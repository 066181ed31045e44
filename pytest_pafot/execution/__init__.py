"""Execution of scenarios: in this process, in other processes, on other machines."""
