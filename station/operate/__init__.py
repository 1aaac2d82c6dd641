"""Procedures with a person: capture, drift check, touch test, a new cell; and the judge of an arm's stops.

They depend on the daemon's protocol only. Shell and screen each pass in a callable by which the person is
asked.
"""
