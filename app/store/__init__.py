"""The store: runs, annotations and parameter sets in a database, and trained random forests as files.

No acknowledged edit is lost, even after a power cut or `kill -9`. All calls block; the server makes them in a
separate thread (`async_store`).
"""
