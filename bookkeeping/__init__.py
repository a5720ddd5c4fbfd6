"""Bookkeeping: small memories at the vertices, and the store that holds what is in them.

`bookkeeping.device` is one device. `bookkeeping.store` says what a store of all of them promises
and gives the reference implementation in memory; `bookkeeping.sqlite_store` keeps the same
promises on disk. Everything here is pure but for the database file; the process around it is
`node.py`.
"""
