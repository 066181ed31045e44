"""Export of findings' runs as files for other tools. The module of a format is imported only if it is requested."""
