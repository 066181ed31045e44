"""The comparison of search algorithms: many runs of each, tidy results, tables, statistics and figures.

pandas, scipy and matplotlib are imported only to make a report.
"""
