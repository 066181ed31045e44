"""The comparison of search algorithms: many runs of each, tidy results, tables, statistics and figures.

No other package of the plugin uses pandas, scipy or matplotlib. They are imported only to make a report.
"""
