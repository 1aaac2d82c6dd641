"""The daemon's protocol: its verbs (`verbs`), its messages, and the two clients that speak it.

`client` is for screens and programs; `stop_client` is STOP from a shell and loads nothing large.
"""
