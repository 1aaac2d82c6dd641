"""MCAP as bytes: writing it, proving it in one pass, and finding what is whole in a damaged file.

Nothing here knows what a recording is. Source: the MCAP format specification, version 0 (mcap.dev/spec).
"""
