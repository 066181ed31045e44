"""The comparison of search algorithms: repeated runs, tables, statistics and figures."""
