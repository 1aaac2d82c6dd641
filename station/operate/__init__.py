"""Flows that a person drives by a shell or by the screen: capture, replan, drift check, touch test.

They know the daemon's protocol alone. What differs between shell and screen is who is asked: a callable or a
small protocol that each of them brings.
"""
