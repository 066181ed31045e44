"""Export of the runs of findings as files for other tools."""
