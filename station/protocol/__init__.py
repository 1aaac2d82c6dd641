"""The daemon's protocol: verbs, messages, and two clients.

`client` is for screens and programs; `stop_client` is STOP from a shell and loads nothing large.
"""
