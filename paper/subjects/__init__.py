"""Values, tables and figures of the report, a subject a file.

Each module has the functions ``values`` (text of each key), ``tables`` and ``figures`` (a function for each name).
"""
