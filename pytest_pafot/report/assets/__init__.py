"""Style and scripts of the report page; read with importlib.resources, never imported."""
