"""Flows that a person drives: capture, drift check, touch test, acceptance of an arm, a new cell.

They know the daemon's protocol alone. What differs between shell and screen is who is asked: a callable or a
small protocol that each of them brings.
"""
