"""The comparison of search algorithms: many runs of each, tidy results, tables, statistics and figures.

The only room that knows pandas, scipy and matplotlib, and only while it makes a report.
"""
