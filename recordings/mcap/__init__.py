"""MCAP by the `mcap` library, with the limits and checks that it leaves to its caller.

Nothing here knows what a recording is.
"""
