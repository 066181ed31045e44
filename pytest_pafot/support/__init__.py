"""Tools that every package of the plugin may need. They know nothing about scenarios."""
