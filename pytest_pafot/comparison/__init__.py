"""The comparison of search algorithms: many runs of each, tables, statistics and figures."""
