"""The comparison of search algorithms: many runs of each, tidy results, tables, statistics and figures.

Only this room uses pandas, scipy and matplotlib, and only while it makes a report.
"""
