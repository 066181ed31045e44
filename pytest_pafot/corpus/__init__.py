"""The files of saved scenarios: format, folders, reading and writing. Only this package imports yaml."""
