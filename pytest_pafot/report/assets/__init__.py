"""The style and the scripts of the report page, read with importlib.resources."""
